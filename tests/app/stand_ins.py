"""Trials that are not composed, and their ends."""

from collections.abc import Sequence
from typing import Any

from gsbench.config.compose import Trial
from gsbench.launch.jobs import Outcome
from tests.launch.test_jobs import trial as bare_trial


def trial(runs: Any, seed: int = 0, words: Sequence[str] = (), **settings: Any) -> Trial:
    settings = {"eval": {"primary": None}} | settings
    launch = {"name": "serial", "parallel": 1, "wait": True}
    return Trial(bare_trial(runs, seed, launch, **settings).values, tuple(words))


def done(trials: Sequence[Trial]) -> list[Outcome]:
    return [Outcome(one.folder, "done") for one in trials]
