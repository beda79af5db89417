"""Made-up trials of claims."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsbench.analysis.results import TrialResult, read_experiment
from gsbench.claims.verdict import Pair, PairKey
from tests.analysis.synthetic import Plan, write_runs


@pytest.fixture
def make_pairs(tmp_path: Path) -> Callable[..., dict[PairKey, Pair]]:
    """Pairs (adc, volumetric) by scene and seed of a made-up experiment; arguments are those of ``synthetic.Plan``."""

    def make(**plan: Any) -> dict[PairKey, Pair]:
        runs = tmp_path / str(np.random.default_rng().integers(1 << 60))
        write_runs(runs, Plan(**({"scene_noise": 0.0} | plan)))
        return pairs_of(read_experiment(runs / "exp").trials)

    return make


def pairs_of(trials: tuple[TrialResult, ...]) -> dict[PairKey, Pair]:
    by_arm = {(trial.densify, trial.scene, trial.seed): trial for trial in trials}
    keys = {(trial.scene, trial.seed) for trial in trials}
    return {(scene, seed): (by_arm["adc", scene, seed], by_arm["volumetric", scene, seed]) for scene, seed in keys}
