"""Trials that are not composed, and their ends."""

from gsbench.config.compose import Trial
from gsbench.launch.jobs import Outcome
from tests.launch.test_jobs import trial as bare_trial


def trial(runs, seed=0, words=(), **settings):
    settings = {"eval": {"primary": None}} | settings
    launch = {"name": "serial", "parallel": 1, "wait": True}
    return Trial(bare_trial(runs, seed, launch, **settings).values, tuple(words))


def done(trials):
    return [Outcome(one.folder, "done") for one in trials]
