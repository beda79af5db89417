"""Trials that are composed only once: Hydra takes a tenth of a second for each."""

import os
from copy import deepcopy
from dataclasses import replace
from functools import cache

from gsbench.app.command import compose_trials


@cache
def _composed(words, multirun, typed):
    return compose_trials(words, multirun, typed)


def composed(words, multirun=True, typed=None):
    """The trials of a command, in this test's runs folder. Equal words are composed once."""
    runs = {"runs": os.environ["GSBENCH_RUNS"]}
    return [
        replace(trial, values=deepcopy(trial.values) | runs)
        for trial in _composed((*words,), multirun, None if typed is None else (*typed,))
    ]
