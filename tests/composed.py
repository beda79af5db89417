"""Trials that are composed only once: Hydra takes a tenth of a second for each."""

import os
from copy import deepcopy
from dataclasses import replace
from functools import cache

from gsbench.app.command import compose_trials


@cache
def _composed(words, multirun):
    return compose_trials(words, multirun)


def composed(words, multirun=True):
    """The trials of a command, in this test's runs folder. Equal words are composed once."""
    runs = {"runs": os.environ["GSBENCH_RUNS"]}
    return [
        replace(trial, values=deepcopy(trial.values) | runs)
        for trial in _composed((*words,), multirun)
    ]
