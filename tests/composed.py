"""Trials that are composed only once: Hydra takes a tenth of a second for each."""

from __future__ import annotations

import os
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace
from functools import cache

from gsbench.app.command import compose_trials
from gsbench.config.compose import Trial


@cache
def _composed(words: tuple[str, ...], multirun: bool, typed: tuple[str, ...] | None) -> list[Trial]:
    return compose_trials(words, multirun, typed)


def composed(
    words: Sequence[str], multirun: bool = True, typed: Sequence[str] | None = None
) -> list[Trial]:
    """The trials of a command, in this test's runs folder. Equal words are composed once."""
    runs = {"runs": os.environ["GSBENCH_RUNS"]}
    return [
        replace(trial, values=deepcopy(trial.values) | runs)
        for trial in _composed((*words,), multirun, None if typed is None else (*typed,))
    ]
