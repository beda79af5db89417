"""Fixtures of the evaluation tests."""

import pytest

from gsbench.analysis.results import load_experiment
from tests.trials import write_runs


@pytest.fixture
def make_experiment(tmp_path):
    """Write the trials of a plan below ``tmp_path`` and load them."""

    def make(experiment="exp", **plan):
        write_runs(tmp_path, experiment=experiment, **plan)
        return load_experiment(tmp_path, experiment)

    return make
