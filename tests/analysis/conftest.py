"""Fixtures of the evaluation tests."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from gsbench.analysis.results import Experiment, load_experiment
from tests.analysis.synthetic import Plan, write_runs


@pytest.fixture
def make_experiment(tmp_path: Path) -> Callable[..., Experiment]:
    """Write the trials of a plan below ``tmp_path`` and load them."""

    def make(**plan: object) -> Experiment:
        made = Plan(**plan)  # type: ignore[arg-type]
        write_runs(tmp_path, made)
        return load_experiment(tmp_path, made.experiment)

    return make
