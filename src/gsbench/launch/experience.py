"""Finished trials, and what they tell of those to come: which are done elsewhere, and how long others take.

All are read once, so that ten thousand planned trials can be held against ten thousand finished ones. Loads no torch.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from itertools import compress
from pathlib import Path
from typing import Any

from gsbench.runs.layout import RESULTS, TRIAL_GLOB
from gsbench.runs.trial_folder import TrialFolder

# Of scene, init and densify, which must be the same: most alike first.
ALIKE = ((True, True, True), (True, False, True), (True, False, False), (False, False, True), (False, False, False))


@dataclass(frozen=True)
class Estimate:
    """Expected seconds of work, and of how many finished trials that is learned (0: nothing is known)."""

    seconds: float
    learned_from: int


@dataclass
class _Times:
    """Sums over finished trials."""

    count: int = 0
    per_iteration: float = 0.0  # s
    evaluate: float = 0.0  # s


class Experience:
    """The finished trials below the folder ``runs``."""

    def __init__(self, runs: Path) -> None:
        self._folders: dict[str, list[Path]] = defaultdict(list)
        self._times: dict[tuple[tuple[bool, ...], tuple[str, ...]], _Times] = defaultdict(_Times)
        for path in runs.glob(f"*/{TRIAL_GLOB}/{RESULTS}"):
            results = TrialFolder(path.parent).sound_record()
            if results is None:
                continue
            self._folders[path.parent.name].append(path.parent)
            if not results.iterations:
                continue
            for same in ALIKE:
                times = self._times[same, tuple(compress((results.scene, results.init, results.densify), same))]
                times.count += 1
                times.per_iteration += results.seconds.get("train", 0.0) / results.iterations
                times.evaluate += results.seconds.get("evaluate", 0.0)

    def elsewhere(self, trial: TrialFolder) -> str | None:
        """The other experiment, if any, that has finished the same trial: its stages are reused, not computed again."""
        others = (folder for folder in self._folders.get(trial.path.name, ()) if folder != trial.path)
        return next((folder.relative_to(trial.runs).parts[0] for folder in others), None)

    def estimate(self, values: dict[str, Any]) -> Estimate:
        """Seconds for the whole trial with ``values``, as finished ones took, most alike first, per iteration."""
        names = tuple(values[group]["name"] for group in ("scene", "init", "densify"))
        for same in ALIKE:
            times = self._times.get((same, tuple(compress(names, same))))
            if times is not None:
                seconds = times.per_iteration * values["train"]["iterations"] + times.evaluate
                return Estimate(seconds / times.count, times.count)
        return Estimate(0.0, 0)
