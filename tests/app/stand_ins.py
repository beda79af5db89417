"""Trials that are not composed, and trainings that take no time."""

import json
from itertools import chain

import numpy as np

from gsbench.errors import GsbenchError
from gsbench.launch.jobs import Outcome, outcome_of_error, outcome_of_results
from gsbench.launch.record import record
from gsbench.runs.code import states_of
from gsbench.runs.commands import digest_of, read_history
from gsbench.runs.keys import CODE_OF_STAGE
from gsbench.runs.layout import RESULTS
from gsbench.runs.trial_record import record_from
from tests.trials import bare_trial, write_as


def trial(runs, seed=0, words=(), **settings):
    launch = {"name": "serial", "parallel": 1, "wait": True}
    return bare_trial(runs, seed, launch, words, **settings)


def done(trials):
    return [Outcome(one.folder, "done") for one in trials]


class Trainings:
    """Stands in for trainings: ``measure`` gives a metric of a trial, from its values.

    ``stops`` and ``fails`` get the number of the training and the trial, and say whether Ctrl-C
    comes in it, or it fails.
    """

    def __init__(self, measure, stops=lambda *_: False, fails=lambda *_: False, metrics=("psnr",)):
        self.measure, self.stops, self.fails, self.metrics = measure, stops, fails, metrics
        self.trained = []
        self.batches = []

    def __call__(self, trials, asks=True):
        record(trials, asks)
        self.batches.append([(one.values["densify"]["name"], one.values["seed"]) for one in trials])
        return [self.run(one) for one in trials]

    def run(self, trial):
        results, values = trial.folder / RESULTS, trial.values
        if not results.exists():
            self.trained.append(trial)
            given = len(self.trained) - 1, trial
            if self.stops(*given):
                raise KeyboardInterrupt
            if self.fails(*given):
                return outcome_of_error(trial.folder, GsbenchError("no luck"))
            views = dict.fromkeys(self.metrics, self.measure(values) + np.arange(3.0))
            history = read_history(trial.files.home)
            asked = history.covering(digest_of(values), values["scene"]["name"], values["seed"])
            code = {"packages": states_of(chain(*CODE_OF_STAGE.values()))}
            write_as(trial, _questions=[one.id for one in asked], _code=code, **views)
        return outcome_of_results(
            trial.folder, record_from(json.loads(results.read_bytes()), results)
        )
