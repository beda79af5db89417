"""Fixtures of the evaluation tests."""

import pytest

from gsbench.analysis.results import load_experiment
from tests.analysis.synthetic import Plan, write_runs


@pytest.fixture
def make_experiment(tmp_path):
    """Write the trials of a plan below ``tmp_path`` and load them."""

    def make(**plan):
        made = Plan(**plan)
        write_runs(tmp_path, made)
        return load_experiment(tmp_path, made.experiment)

    return make
