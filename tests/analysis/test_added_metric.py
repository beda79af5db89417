"""A user's own metric that is added later: for older trials its setting counts as unset."""

import pytest

from gsbench.analysis.cells import select_trials
from gsbench.analysis.tables import build_table
from tests.analysis.helpers import loaded, table_of
from tests.helpers import refusal
from tests.trials import write_trial

KEY = "eval.extra.mae._target_"
OWN = {"eval.extra": {"mae": {"_target_": "mine.Mae"}}}


@pytest.fixture
def runs(tmp_path):
    for seed in (0, 1):
        for densify in ("adc", "volumetric"):
            write_trial(tmp_path, seed, "aaaaaaaa", densify=densify, psnr=27.0 + seed)
            write_trial(tmp_path, seed, "bbbbbbbb", OWN, densify=densify, psnr=27.0 + seed, mae=3.0)
    return tmp_path


def test_tables_show_trials_with_and_without_the_metric(runs):
    experiment = loaded(runs)
    table = build_table(experiment)
    assert table.row_headings == ("scene", "init", "densify", KEY)
    shown = {(row.labels[2], row.labels[3]) for row in table.rows if row.labels[0] == "garden"}
    assert shown == {(arm, value) for arm in ("adc", "volumetric") for value in ("–", "mine.Mae")}
    assert len(select_trials(experiment.trials, {KEY: "mine.Mae"})) == 4
    assert len(select_trials(experiment.trials, {KEY: "None"})) == 4


def test_a_null_setting_equals_a_missing_key(tmp_path):
    write_trial(tmp_path, 0, "aaaaaaaa", psnr=27.0)
    write_trial(tmp_path, 1, "bbbbbbbb", {"eval.extra": None}, psnr=28.0)
    table = table_of(tmp_path, "psnr")
    assert [row.entries[0].text for row in table.rows] == ["27.50 ± 0.71"]


@pytest.mark.parametrize("name", ["eval.extra.mea._target_", "densify.volume_treshold", "nothing"])
def test_a_key_that_no_trial_has_is_refused(runs, name):
    experiment = loaded(runs)
    with refusal(f"no trial has a setting '{name}'"):
        build_table(experiment, rows=["scene", name])
    with refusal(f"no trial has a setting '{name}'"):
        select_trials(experiment.trials, {name: "None"})
