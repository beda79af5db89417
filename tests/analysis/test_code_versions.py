"""Table cells never mix versions of the code, and superseded trials are named."""

import os

import pytest

from gsbench.analysis.report.build import build_report
from gsbench.analysis.tables import build_table
from gsbench.verbs.results import explain_cell
from tests.analysis.helpers import loaded, table_of
from tests.trials import write_trial

OLD, NEW = "1" * 64, "2" * 64
STAGES = {"scene": 1, "init": 1, "train": 1, "evaluate": 1}
MINE = {"densify._target_": "mine.Patient"}


def code(digest=None, **stages):
    return {"sources": {} if digest is None else {"mine": digest}, "stages": STAGES | stages}


def of_gsbench(**packages):
    return code() | {"packages": packages}


def finished_at(path, seconds):
    os.utime(path / "results.json", (seconds, seconds))
    return path


def test_the_newest_code_counts_and_one_line_names_all_earlier_versions(tmp_path):
    for seed in (0, 1):
        finished_at(write_trial(tmp_path, seed, "aaaaaaaa", MINE, psnr=27.0, _code=code(OLD)), 1000)
    finished_at(write_trial(tmp_path, 1, "cccccccc", MINE, psnr=26.0, _code=code("3" * 64)), 1500)
    finished_at(write_trial(tmp_path, 1, "bbbbbbbb", MINE, psnr=28.0, _code=code(NEW)), 2000)
    words = (
        "exp: 3 trials of sfm-adc made by earlier versions of mine: 11111111 (2), 33333333 (1); "
        "the trials that count have 22222222"
    )
    experiment = loaded(tmp_path)
    assert experiment.warnings == (words,)
    assert [trial.seed for trial in experiment.trials] == [1]
    table = build_table(experiment, metrics=["psnr"])
    assert table.rows[0].entries[0].text == "28.00"
    assert f"Left out (3): {words}." in table.notes
    assert words in explain_cell("exp:garden:psnr:adc", tmp_path)
    page = build_report(experiment)
    assert (words in page, "Not in this report: 3 of" in page) == (True, True)
    write_trial(tmp_path, 0, "dddddddd", psnr=26.0, densify="other", _code=code())
    assert words not in explain_cell("exp:garden:psnr:other", tmp_path)


@pytest.mark.parametrize(
    "old, new, part",
    [
        ({"_code": code()}, {"_code": code(train=2)}, "stage train"),
        (
            {"_code": {**code(), "packages": {"train": "released"}}},
            {"_code": {**code(), "packages": {"train": "c" * 16}}},
            "gsbench's train",
        ),
    ],
)
def test_older_trials_of_gsbench_are_left_out(tmp_path, old, new, part):
    finished_at(write_trial(tmp_path, psnr=27.0, **old), 1000)
    finished_at(write_trial(tmp_path, 1, psnr=27.0, **new), 2000)
    experiment = loaded(tmp_path)
    assert [trial.seed for trial in experiment.trials] == [1]
    assert f"made by earlier versions of {part}: " in experiment.warnings[0]


@pytest.mark.parametrize(
    "first, second, best",
    [
        ({"_code": code(OLD)}, {"_code": code(NEW)}, False),
        ({"_code": code()}, {"_code": code(NEW)}, True),
        (
            {"_code": of_gsbench(train="a" * 16)},
            {"_code": of_gsbench(train="a" * 16, external="b" * 16)},
            True,
        ),
    ],
    ids=["two versions of a class", "a class of one arm", "a package of one arm"],
)
def test_arms_are_compared_unless_they_share_code_in_two_versions(tmp_path, first, second, best):
    write_trial(tmp_path, 0, "aaaaaaaa", psnr=27.0, **first)
    write_trial(tmp_path, 0, "bbbbbbbb", psnr=28.0, densify="other", **second)
    table = table_of(tmp_path, "psnr")
    said = "the arms differ in code of mine, so they are not compared"
    assert (said in table.verdicts[0]) == (not best)


def test_explain_names_the_commit_and_the_edited_packages(tmp_path):
    made = of_gsbench(train="released", eval="a" * 16) | {"commit": "0123abcd", "edited": True}
    write_trial(tmp_path, psnr=27.0, _code=made)
    said = explain_cell("exp:garden:psnr:adc", tmp_path)
    assert "commit    0123abcd, edited" in said
    assert "edited    since the last release: eval" in said
    unreleased = of_gsbench(train="b" * 16, eval="a" * 16) | {"commit": "0123abcd", "edited": False}
    write_trial(tmp_path / "other", 0, psnr=27.0, _code=unreleased)
    said = explain_cell("exp:garden:psnr:adc", tmp_path / "other")
    assert "commit    0123abcd\n" in said
    assert "since the last release" not in said


def test_a_module_that_only_one_arm_has_makes_no_version(tmp_path):
    """A sweep over ``train.terms=[],[…]``: the baseline has no module, the idea has one."""
    term = {"train.terms": [{"_target_": "mine.Term", "weight": 0.1}]}
    for seed in (0, 1):
        finished_at(write_trial(tmp_path, seed, "aaaaaaaa", psnr=27.0), 1000)
        finished_at(write_trial(tmp_path, seed, "bbbbbbbb", term, psnr=28.0, _code=code(OLD)), 2000)
    experiment = loaded(tmp_path)
    assert not experiment.warnings
    assert len(experiment.trials) == 4
    # an edit of the term folds the trials with it, and leaves the baseline
    finished_at(write_trial(tmp_path, 0, "cccccccc", term, psnr=29.0, _code=code(NEW)), 3000)
    experiment = loaded(tmp_path)
    assert sorted(trial.metrics["psnr"] for trial in experiment.trials) == [27, 27, 29]
    assert len(experiment.older) == 2


def test_an_idea_of_two_modules_leaves_the_arm_with_one(tmp_path):
    both = code(OLD)
    both["sources"]["term"] = "7" * 64
    finished_at(write_trial(tmp_path, 0, "aaaaaaaa", MINE, psnr=27.0, _code=code(OLD)), 1000)
    more = MINE | {"train.terms": [{"_target_": "term.Term", "weight": 0.1}]}
    finished_at(write_trial(tmp_path, 0, "bbbbbbbb", more, psnr=28.0, _code=both), 2000)
    assert not loaded(tmp_path).warnings
