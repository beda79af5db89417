"""``gsbench plan``, with made-up results."""

import re
from shlex import split

import pytest

from gsbench.verbs.planning import PLANNED, plan
from tests.helpers import change_json, refusal
from tests.trials import ask_about, write_runs, write_trial


@pytest.fixture
def pilots(tmp_path):
    """The runs folder of three experiments: on three scenes, on one, and with a single arm."""
    write_runs(tmp_path, scenes=("a", "b", "c"), trial_noise=0.3, effect_noise=0.2)
    write_runs(tmp_path, experiment="one", scenes=("a",), trial_noise=0.3)
    write_runs(tmp_path, experiment="alone", densifiers=("adc",))
    for densify, seeds in (("adc", (0, 1)), ("volumetric", (2, 3))):
        write_runs(tmp_path, experiment="apart", densifiers=(densify,), seeds=seeds)
    return tmp_path


def test_plan_names_designs_that_suffice(pilots, capsys):
    assert plan(split("exp --metric psnr --difference 0.2"), pilots) == 0
    out = capsys.readouterr().out
    assert "sfm-volumetric against sfm-adc" in out
    assert "(from 9 pairs on 3 scenes)" in out
    assert "scenes like these (from 6 scenes on)" in out


def test_plan_is_about_the_metric_that_was_asked_about(pilots, capsys):
    ask_about(pilots, metric="ssim")
    assert plan(["exp"], pilots) == 0
    assert "differences in SSIM vary between seeds" in capsys.readouterr().out


def test_more_questions_need_more_trials_and_all_are_new_ones(pilots, capsys):
    trials = []
    for count in ("1", "4"):
        assert plan(["exp", "--difference", "0.5", "--questions", count], pilots) == 0
        out = capsys.readouterr().out
        trials.append(int(re.search(r"on these scenes.*?\((\d+) trials", out)[1]))
        assert "seeds that the pilot does not have (it has 0, 1, 2), under another name" in out
        assert PLANNED.partition(" {")[0] in out
        assert re.search(r"only within 0\.\d+ to 1\.\d+ times \(80 % of pilots\)", out)
    assert trials[0] < trials[1]


def test_arms_that_cannot_be_planned_for_are_named_beside_the_others(pilots, capsys):
    """One is equal to the baseline, another has one seed."""
    (pilots / "one").rename(pilots / "some")
    for path in (pilots / "some").glob("*/*/*/results.json"):
        data = change_json(path, experiment="some")
        arm = "same" if data["densify"] == "adc" else "short"
        if arm == "same" or data["seed"] == 0:
            place = {"experiment": "some", "scene": data["scene"], "densify": arm}
            write_trial(pilots, data["seed"], **place, psnr=data["metrics"]["psnr"])
    assert plan(["some"], pilots) == 0
    out = capsys.readouterr().out
    assert "sfm-adc and sfm-same: differences in PSNR (dB) do not vary between seeds" in out
    assert "sfm-adc and sfm-short: planning needs pilot trials with at least two seeds" in out
    assert "sfm-volumetric against sfm-adc\n  differences in PSNR (dB) vary" in out


def test_pilot_trials_on_one_scene_give_no_plan_for_scenes_like_these(pilots, capsys):
    assert plan(["one"], pilots) == 0
    assert "run pilot trials on a second scene" in capsys.readouterr().out


@pytest.mark.parametrize(
    "words, message",
    [
        ("exp --metric psn", "unknown metric"),
        ("exp --metric gaussians", "not counts"),
        ("exp --difference 0", "above 0"),
        ("alone", "one arm"),
        ("apart", r"no trials of sfm-adc and sfm-volumetric can be paired in PSNR"),
        ("nothing", "no experiment"),
    ],
)
def test_bad_input_of_plan_is_refused(pilots, words, message):
    with refusal(message):
        plan(split(words), pilots)
