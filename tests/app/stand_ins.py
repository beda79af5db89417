"""Trials that are not composed, and their ends."""

from gsbench.launch.outcomes import Outcome
from tests.trials import bare_trial


def trial(runs, seed=0, words=(), **settings):
    launch = {"name": "serial", "parallel": 1, "wait": True}
    return bare_trial(runs, seed, launch, words, **settings)


def done(trials):
    return [Outcome(one.folder, "done") for one in trials]
