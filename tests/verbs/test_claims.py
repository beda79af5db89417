"""``gsbench plan``: the words it prints for made-up trials, and what it refuses."""

from __future__ import annotations

from pathlib import Path

import pytest

from gsbench.errors import InputError
from gsbench.verbs.claims import plan
from tests.analysis.synthetic import Plan, write_runs


@pytest.fixture
def runs(tmp_path) -> Path:
    write_runs(tmp_path, Plan(scenes=("a", "b", "c"), trial_noise=0.3, effect_noise=0.2))
    write_runs(tmp_path, Plan(experiment="one", scenes=("a",), trial_noise=0.3))
    write_runs(tmp_path, Plan(experiment="alone", densifiers=("adc",)))
    return tmp_path


def test_plan_names_designs_that_suffice(runs, capsys):
    assert plan(["exp", "--metric", "psnr", "--difference", "0.2"], runs) == 0
    out = capsys.readouterr().out
    assert "sfm-volumetric against sfm-adc" in out
    assert "(from 9 pairs on 3 scenes)" in out
    assert "scenes like these (from 6 scenes on)" in out


def test_pilot_trials_on_one_scene_give_no_plan_for_scenes_like_these(runs, capsys):
    assert plan(["one"], runs) == 0
    assert "run pilot trials on a second scene" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["exp", "--metric", "psn"], "unknown metric"),
        (["exp", "--metric", "gaussians"], "not counts"),
        (["exp", "--difference", "0"], "above 0"),
        (["alone"], "one arm"),
        (["nothing"], "no experiment"),
    ],
)
def test_bad_input_of_plan_is_refused(runs, words, message):
    with pytest.raises(InputError, match=message):
        plan(words, runs)
