"""Writing commands and questions down before trials run."""

import logging
from dataclasses import replace
from shlex import split

import pytest

from gsbench.app.command import compose_trials
from gsbench.launch.record import asked_metrics, check_looks, planned_rows, record, remove
from gsbench.runs.commands import (
    Ledger,
    append,
    command_now,
    digest_of,
    read_history,
    remember_result,
)
from gsbench.runs.experiments import Arm
from tests.end_to_end.conftest import SMALL
from tests.helpers import refusal, table
from tests.trials import bare_trial, write_trial

# later words win: a trial of seconds
TINY = SMALL + split(
    "train.iterations=2 scene.views=9 scene.width=48 scene.height=36 init.count=200 "
    "raster=reference eval.lpips=[] eval.flip=false tracking=none densify=none"
)


def trial(runs, seed=0, densify="adc", eval=None, words=("x=1",), **settings):
    """A trial of a command of the experiment ``exp``."""
    groups = {"densify": {"name": densify} | settings, "scene": {"name": "courtyard"}}
    return bare_trial(runs, seed, words=words, name="exp", eval=eval or {}, **groups)


def sweep(runs, *seeds, eval=None, **settings):
    return [
        trial(runs, seed, name, eval, **(settings if name == "mine" else {}))
        for name in ("adc", "mine")
        for seed in seeds
    ]


def finish(*trials):
    for one in trials:
        remember_result(one.files.home, one.folder, digest_of(one.values))


def history(runs):
    return read_history(runs / "exp")


def test_a_command_writes_its_trials_and_one_question_by_default_about_psnr(tmp_path, caplog):
    with caplog.at_level(logging.INFO):
        (question,) = record(sweep(tmp_path, 0, 1))
    assert (question.metric, question.sign, question.level) == ("psnr", 1, 0.05)
    assert (question.baseline, question.idea) == (Arm("a_init", "adc"), Arm("a_init", "mine"))
    assert question.seeds == {"courtyard": (0, 1)}
    assert history(tmp_path).questions == (question,)
    assert len(history(tmp_path).planned) == 4
    assert "first on these seeds: 5 %" in caplog.text


def test_the_same_command_and_parts_of_it_add_no_line(tmp_path):
    trials = sweep(tmp_path, 0, 1)
    (question,) = record(trials)
    before = (tmp_path / "exp/commands.jsonl").read_bytes()
    for again, shown in ((trials, [question]), (trials[:1], []), (trials[2:], [question])):
        assert record(again) == shown
        assert (tmp_path / "exp/commands.jsonl").read_bytes() == before


def test_further_settings_have_a_smaller_level_once_the_first_gave_a_result(tmp_path):
    first = sweep(tmp_path, 0, 1)
    record(first)
    (untried,) = record(sweep(tmp_path, 0, 1, decay=1))
    assert untried.n == 1
    finish(*first)
    (second,) = record(sweep(tmp_path, 0, 1, decay=2))
    assert (second.n, second.level) == (2, pytest.approx(0.05 / 3))


def test_a_result_that_was_removed_still_counts(tmp_path):
    first = sweep(tmp_path, 0, 1)
    record(first)
    finish(*first)
    for one in first:
        one.folder.mkdir(parents=True)
    remove(tmp_path / "exp", [one.folder for one in first])
    assert not history(tmp_path).planned
    (second,) = record(sweep(tmp_path, 0, 1, decay=1))
    assert second.n == 2


def test_a_repeated_question_becomes_the_newest_again(tmp_path):
    old, new = sweep(tmp_path, 0, 1), sweep(tmp_path, 0, 1, decay=1)
    (first,), (second,) = record(old), record(new)
    record(old)
    assert [one.id for one in history(tmp_path).questions] == [second.id, first.id]


def test_searches_ledgers_and_verbs_with_rules_of_their_own_ask_nothing(tmp_path):
    assert record(sweep(tmp_path, 0, 1), asks=False) == []
    assert len(history(tmp_path).planned) == 4
    (tmp_path / "exp/tuning.json").touch()
    assert record(sweep(tmp_path, 2, 3)) == []
    (tmp_path / "exp/tuning.json").unlink()
    opened = {"metric": "psnr", "sign": 1, "least": 0.5, "relative": False, "ideas": 40}
    ledger = Ledger(**opened, rate=0.1, seeds=(0, 1))
    append(tmp_path / "exp", lambda history: command_now(ledger=ledger))
    assert record(sweep(tmp_path, 4, 5)) == []


def test_a_trial_that_is_read_from_its_own_record_is_no_command(tmp_path):
    record([trial(tmp_path, words=())])
    assert not (tmp_path / "exp").exists()


def test_one_experiment_has_one_metric_in_a_command(tmp_path):
    two = [trial(tmp_path, eval={"primary": metric}) for metric in ("psnr", "ssim")]
    with refusal("eval.primary=psnr and eval.primary=ssim"):
        record(two)
    assert asked_metrics(two[:1]) == {tmp_path / "exp": "psnr"}


def test_metric_baseline_and_least_difference_come_from_the_settings(tmp_path):
    trials = sweep(tmp_path, 0, 1, eval={"primary": "lpips_vgg", "baseline": "mine"})
    (question,) = record(trials)
    assert (question.sign, question.least) == (-1, 0.005)
    assert (question.baseline.densify, question.idea.densify) == ("mine", "adc")


def test_an_earlier_baseline_is_found_by_its_results(tmp_path):
    adc = trial(tmp_path)
    path = write_trial(
        tmp_path,
        0,
        adc.folder.name.partition("-")[0],
        experiment="exp",
        scene="courtyard",
        init="a_init",
        psnr=20.0,
    )
    assert path == adc.folder
    (question,) = record([trial(tmp_path, densify="mine")])
    assert question.digests["courtyard"][0].partition("+")[0] == "/".join(
        [adc.folder.parent.name, adc.folder.name.partition("-")[0]]
    )


def test_looks_need_equal_seeds_of_all_scenes_and_arms(tmp_path):
    trials = sweep(tmp_path, 0, 1, 2)
    assert check_looks(trials, planned_rows(trials)) == (0, 1, 2)
    with refusal("needs the same seeds everywhere"):
        check_looks(trials[1:], planned_rows(trials[1:]))
    single = sweep(tmp_path, 0)
    with refusal("at least 2 seeds"):
        check_looks(single, planned_rows(single))


def named(runs, *entries, error_rate="each", densifiers=("adc", "mine", "other")):
    """The questions of a sweep whose file names these."""
    values = {"questions": list(entries), "error_rate": error_rate}
    trials = [trial(runs, seed, name) for name in densifiers for seed in (0, 1)]
    return record([replace(one, values=one.values | values) for one in trials])


def test_an_experiments_file_names_other_questions_in_place_of_the_usual_ones(tmp_path):
    (one,) = named(
        tmp_path,
        {
            "idea": "other",
            "baseline": "mine",
            "metric": "gaussians",
            "direction": "lower",
            "least": "10%",
            "says": "fewer",
            "where": "Table 3",
        },
    )
    assert (one.idea.densify, one.baseline.densify) == ("other", "mine")
    assert (one.metric, one.sign, one.least, one.relative) == ("gaussians", -1, 0.1, True)
    assert (one.says, one.where, one.level) == ("fewer", "Table 3", 0.05)


def test_questions_may_share_one_error_rate(tmp_path):
    entries = ({"idea": "mine"}, {"idea": "other"})
    assert [one.level for one in named(tmp_path / "a", *entries)] == [0.05, 0.05]
    shared = named(tmp_path / "b", *entries, error_rate="shared")
    assert [one.level for one in shared] == [0.025, 0.025]


def test_a_question_may_be_about_some_scenes_alone(tmp_path):
    entry = {"idea": "mine", "scenes": ["elsewhere"]}
    with refusal("mine names no arm of this sweep"):
        named(tmp_path, entry)
    (found,) = named(tmp_path / "b", entry | {"scenes": ["courtyard"]})
    assert [*found.seeds] == ["courtyard"]


def test_a_part_of_a_declared_sweep_leaves_out_the_questions_whose_arms_it_lacks(tmp_path):
    entries = ({"idea": "mine"}, {"idea": "other", "baseline": "mine"})
    mine, other = named(tmp_path, *entries)
    assert named(tmp_path, *entries, densifiers=("adc", "mine")) == [mine]
    assert named(tmp_path, *entries, densifiers=("adc",)) == []
    assert history(tmp_path).questions == (mine, other)
    with refusal("third names no arm of this sweep"):  # a new question lacks its arm
        named(tmp_path, *entries, {"idea": "third"})


@pytest.mark.parametrize(
    "entry, said",
    table(__file__, "a_wrong_question_is_refused_in_one_line_before_anything_is_written"),
)
def test_a_wrong_question_is_refused_in_one_line_before_anything_is_written(tmp_path, entry, said):
    with refusal(said):
        named(tmp_path, entry)
    assert not (tmp_path / "exp").exists()


def test_declare_writes_questions_and_single_trainings_ask_nothing_more(runs, said):
    words = [*(word for word in TINY if word != "densify=none"), "name=loop"]
    sweep_words = ["densify=adc,volumetric", "seed=0,1"]
    assert "4 trials and 1 question" in said("declare", *words, *sweep_words)
    assert not list(runs.glob("loop/*/*/*"))
    (question,) = read_history(runs / "loop").questions
    for densify in ("adc", "volumetric"):
        single = compose_trials([*words, f"densify={densify}", "seed=1"])
        assert record(single) == ([question] if densify == "volumetric" else [])
    assert read_history(runs / "loop").questions == (question,)
