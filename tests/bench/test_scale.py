"""Verbs over an experiment of many trials: their output is right; their time is only printed."""

import pytest

from benchmarks.scale import NAME, timed, write_all
from gsbench.analysis.results import load_experiment
from gsbench.analysis.tables import build_table

pytestmark = pytest.mark.slow


def test_many_trials_are_read_and_averaged(tmp_path):
    """For ten thousand trials: `python -m benchmarks.scale FOLDER 50 20 10`."""
    assert write_all(tmp_path, scenes=3, arms=4, seeds=5) == 60
    experiment = load_experiment(tmp_path, NAME)
    assert len(experiment.trials) == 60
    assert experiment.warnings == ()
    table = build_table(experiment, metrics=["psnr"])
    assert table.row_headings == ("scene", "init", "densify", "densify.volume_threshold")
    assert len(table.rows) == 3 * 4 + 4
    cpu, wall = timed(tmp_path, ["tables", NAME])
    print(f"tables of 60 trials: {cpu:.1f} s CPU, {wall:.1f} s")
