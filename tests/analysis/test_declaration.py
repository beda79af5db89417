"""Declared metrics: which tests are adjusted together, and what is said of late declarations."""

import calendar
import json
import os
import shutil
import time
from dataclasses import replace

import numpy as np
import pytest

from gsbench.analysis.comparison import compare
from gsbench.analysis.declaration import active_declaration
from gsbench.analysis.notes import texts
from gsbench.analysis.report.build import build_report
from gsbench.analysis.results import load_experiment
from gsbench.analysis.statistics import answer_family
from gsbench.analysis.tables import build_table
from gsbench.analysis.verdict_words import families, in_words, p_text
from gsbench.runs.experiments import (
    STAMP,
    Arm,
    Declaration,
    Question,
    latest_declaration,
    open_question,
    read_declarations,
    record_text,
)
from tests.analysis.synthetic import Plan, write_runs

EARLY, LATE = "2020-01-01T00:00:00Z", "2037-01-01T00:00:00Z"
CLEAR = {"lpips_vgg_raw": -0.05}


def declare(runs, *records, experiment="exp"):
    entries = [
        Declaration(time=moment, questions=(open_question(metric),)) for metric, moment in records
    ]
    (runs / experiment / "declared.jsonl").write_text(record_text(entries))


def declared_experiment(runs, *records, **plan):
    write_runs(runs, Plan(**plan))
    declare(runs, *records)
    return load_experiment(runs, "exp")


def judged(experiment):
    return list(compare(experiment).answers)


def standing(experiment):
    """How the declaration stands to the question about the only compared arm."""
    (one,) = judged(experiment)
    assert one.standing is not None
    return one.standing


def lines(experiment):
    return "\n".join(texts(compare(experiment).declared_notes))


def test_a_declaration_about_one_question_says_so(tmp_path):
    experiment = declared_experiment(tmp_path, ("psnr@extrapolation", EARLY))
    assert lines(experiment).startswith("PSNR (dB) at extrapolation was declared beforehand")


def test_a_verdict_in_words_has_its_numbers(tmp_path):
    (one,) = judged(declared_experiment(tmp_path, ("lpips_vgg_raw", EARLY), effect=CLEAR))
    first, second = one.verdicts[0], one.verdicts[1]
    for verdict, adjusted in ((first, ""), (second, ", adjusted for 3 tests")):
        assert verdict.interval is not None
        assert verdict.p is not None
        p = "below 0.001" if verdict.p < 0.001 else f"{verdict.p:.3f}"
        numbers = (
            f"{verdict.shown(verdict.mean or 0.0)} (interval "
            f"{verdict.shown_interval(verdict.interval)}, p {p}"
        )
        assert f"on these scenes: {numbers}{adjusted})" in in_words(verdict)
    assert (p_text(0.001), p_text(0.0009), p_text(0.0126)) == ("0.001", "below 0.001", "0.013")
    assert families([one]) == [
        "The declared metric is not adjusted: it is one test.",
        "All other metrics are secondary and do not decide the verdict; Holm adjusts them for 3 "
        "tests.",
    ]


# --- families


def test_the_declared_metric_of_one_pair_is_not_adjusted_and_the_others_are(tmp_path):
    (one,) = judged(declared_experiment(tmp_path, ("flip", EARLY), effect=CLEAR))
    assert [verdict.quantity.key for verdict in one.verdicts] == [
        "flip",
        "psnr",
        "ssim",
        "lpips_vgg_raw",
    ]
    assert [one.role(verdict) for verdict in one.verdicts] == ["declared", *["secondary"] * 3]
    first, *others = one.verdicts
    assert first.family == 1
    assert first.p == pytest.approx(alone(first))
    # Holm by hand: times 3, 2, 1 from the smallest, never below the one before.
    ordered = sorted(others, key=alone)
    expected, running = [], 0.0
    for factor, verdict in zip((3, 2, 1), ordered, strict=True):
        running = max(running, min(1.0, factor * alone(verdict)))
        expected.append(running)
    assert [verdict.p for verdict in ordered] == pytest.approx(expected)
    assert ordered[0].outcome == "supported"  # a clear effect is found in a secondary metric, too


def alone(verdict):
    """The p of a verdict's test by itself."""
    assert verdict.answer is not None
    assert verdict.answer.test is not None
    return verdict.answer.test.p


def test_with_several_arms_the_declared_metric_is_adjusted_for_their_number(tmp_path):
    arms = ("adc", "volumetric", "absgrad", "mcmc")
    found = judged(
        declared_experiment(tmp_path, ("lpips_vgg_raw", EARLY), effect=CLEAR, densifiers=arms)
    )
    firsts = [one.verdicts[0] for one in found]
    assert [verdict.family for verdict in firsts] == [3, 3, 3]
    least = min(firsts, key=alone)
    assert least.p == pytest.approx(3 * alone(least))
    assert least.outcome == "supported"
    assert all(one.family == 9 for arms in found for one in arms.verdicts[1:])


def test_a_difference_that_a_single_test_shows_may_be_undecided_in_a_family():
    rng = np.random.default_rng(3)
    noise = [rng.normal(0, 0.1, (1, 3)) for _ in range(9)]
    weak = np.array([[0.9, 1.0, 1.3]])
    (single,) = answer_family([weak])
    assert single.outcome(1, None) == "supported"
    first = answer_family([weak, *noise])[0]
    assert single.p is not None
    assert first.p == pytest.approx(10 * single.p)
    assert first.outcome(1, None) == "undecided"


# --- what report and table say


def test_the_report_says_what_was_declared_and_what_is_secondary(tmp_path):
    page = build_report(
        declared_experiment(
            tmp_path, ("lpips_vgg_raw", EARLY), effect=CLEAR, views=3, random_seed=1
        )
    )
    assert "LPIPS VGG raw was declared beforehand (eval.primary, 2020-01-01 00:00 UTC)." in page
    assert "sfm-volumetric against sfm-adc: better in LPIPS VGG raw on these scenes: −" in page
    assert "The metric was declared beforehand." in page
    assert "Secondary, adjusted for their number: undecided in" in page
    assert "Interval and p are adjusted" in page
    assert "no metric was declared" not in page


def test_without_a_declaration_all_metrics_are_one_family_and_the_report_says_so(tmp_path):
    write_runs(tmp_path, Plan(effect=CLEAR, views=3))
    experiment = load_experiment(tmp_path, "exp")
    page = build_report(experiment)
    assert (
        "Exploratory: no metric was declared (eval.primary), so all metrics count, adjusted for "
        "their number (4)" in page
    )
    assert "4 tests adjusted by Holm" in page
    (one,) = judged(experiment)
    assert {(one.role(v), v.family) for v in one.verdicts} == {("", 4)}
    assert all("4 tests)" in in_words(v) for v in one.verdicts)
    least = min(one.verdicts, key=alone)
    assert least.p == pytest.approx(4 * alone(least))
    (verdict,) = (note for note in build_table(experiment).notes if note.startswith("Verdict"))
    assert verdict.removeprefix("Verdict, ") in page


def test_tables_have_the_verdict_on_the_declared_metric_whichever_trials_they_show(tmp_path):
    experiment = declared_experiment(tmp_path, ("lpips_vgg_raw", EARLY), effect=CLEAR)
    whole = [note for note in build_table(experiment).notes if note.startswith("Verdict")]
    assert len(whole) == 1
    assert whole[0].startswith(
        "Verdict, sfm-volumetric against sfm-adc: better in LPIPS VGG raw on these scenes: −0.05"
    )
    part = build_table(
        experiment, [trial for trial in experiment.trials if trial.scene == "garden"]
    )
    assert [note for note in part.notes if note.startswith("Verdict")] == whole


def test_a_declared_metric_without_weights_has_no_verdict_and_no_other_replaces_it(tmp_path):
    experiment = declared_experiment(tmp_path, ("lpips_alex", EARLY), effect=CLEAR)
    (one,) = judged(experiment)
    assert "lpips_alex" not in [verdict.quantity.key for verdict in one.verdicts]
    assert {one.role(verdict) for verdict in one.verdicts} == {"secondary"}
    assert texts(one.notes) == ["LPIPS Alex: weights file alexnet.pth not found"]
    assert families([one]) == [
        "All other metrics are secondary and do not decide the verdict; Holm adjusts them for 4 "
        "tests."
    ]
    reason = "the declared metric LPIPS Alex has no value (weights file alexnet.pth not found)"
    assert f"no verdict, since {reason}" in build_report(experiment)
    (note,) = (note for note in build_table(experiment).notes if note.startswith("Verdict"))
    assert f"no verdict, since {reason}" in note


# --- when it was declared


def test_a_declaration_after_results_is_reported_and_all_metrics_are_one_family(tmp_path):
    experiment = declared_experiment(tmp_path, ("lpips_vgg_raw", LATE), effect=CLEAR, views=3)
    (one,) = judged(experiment)
    assert {(one.role(verdict), verdict.family) for verdict in one.verdicts} == {("", 4)}
    page = build_report(experiment)
    assert "on these scenes: better in LPIPS VGG raw (−" in page
    assert (
        "LPIPS VGG raw was declared, but only after 6 trials of the arm had been measured" in page
    )
    assert "declared beforehand." not in page


def test_a_repeated_declaration_counts_from_its_first_time():
    psnr, later, flip = (
        Declaration(time=time, questions=(Question(metric=metric, sign=0),))
        for metric, time in (("psnr", EARLY), ("psnr", LATE), ("flip", LATE))
    )
    assert latest_declaration([psnr]) is psnr
    assert latest_declaration([psnr, later]) is psnr
    assert latest_declaration([flip, psnr, later]) is psnr
    assert latest_declaration([psnr, flip, later]) is later


@pytest.mark.parametrize(
    "records, metric, other",
    [
        ([("psnr", EARLY), ("flip", LATE)], "PSNR (dB)", "flip (2037-01-01 00:00 UTC)"),
        ([("flip", EARLY), ("psnr", EARLY)], "PSNR (dB)", "flip (2020-01-01 00:00 UTC)"),
    ],
    ids=["after the results", "replaced before them"],
)
def test_another_declared_metric_is_reported(tmp_path, records, metric, other):
    said = lines(declared_experiment(tmp_path, *records))
    assert f"{metric} was declared beforehand" in said
    assert f"Also declared, but in force for no arm: {other}." in said


OLDER = (0, 1, 3)  # two trials of the baseline, which do no harm, and one of the arm


def test_the_time_of_measuring_counts_not_that_of_writing_results(tmp_path):
    """The store gives another experiment the same numbers at once, with their ``measured``."""
    paths = write_runs(tmp_path, Plan(scenes=("garden",)))
    declare(tmp_path, ("psnr", "2030-06-01T00:00:00Z"))
    after = calendar.timegm(time.strptime("2030-06-02T00:00:00Z", STAMP))
    for place, path in enumerate(paths):
        data = json.loads((path / "results.json").read_text())
        if place in OLDER:
            data["measured"] = "2030-05-31T00:00:00Z"
        (path / "results.json").write_text(json.dumps(data))
        os.utime(path / "results.json", (after, after))
    found = standing(load_experiment(tmp_path, "exp"))
    assert {trial.path for trial in found.seen} == {paths[3]}
    assert not found.beforehand


def test_a_declaration_is_read_from_trials_if_its_record_is_gone(tmp_path):
    path = write_runs(tmp_path, Plan())[0]
    data = json.loads((path / "results.json").read_text())
    (path / "results.json").write_text(
        json.dumps(data | {"declared": {"metric": "psnr", "time": EARLY}})
    )
    experiment = load_experiment(tmp_path, "exp")
    repeated = [trial.record.declared for trial in experiment.trials]
    assert [one.primary for one in read_declarations(experiment.folder, repeated)] == ["psnr"]
    assert read_declarations(tmp_path / "nothing") == []


# --- which trials were declared with it


def declare_trials(runs, *records, metric="lpips_vgg_raw"):
    asked = (open_question(metric),)
    entries = [
        Declaration(time=moment, questions=asked).to_json() | {"trials": trials}
        for moment, trials in records
    ]
    (runs / "exp" / "declared.jsonl").write_text(
        "".join(json.dumps(entry) + "\n" for entry in entries)
    )


def planned(seeds, arms=("adc", "volumetric")):
    return {
        f"{scene}/sfm-{arm}/c0ffee00": seeds for scene in ("courtyard", "garden") for arm in arms
    }


def test_a_metric_declared_with_all_trials_is_declared_beforehand(tmp_path):
    experiment = declared_experiment(tmp_path, effect=CLEAR)
    declare_trials(tmp_path, (EARLY, planned([0, 1, 2])))
    assert standing(experiment).beforehand
    assert lines(experiment).count("\n") == 0
    declare_trials(tmp_path, (EARLY, planned([0])), ("2020-01-02T00:00:00Z", planned([0, 1, 2])))
    # added while no result was there
    assert standing(experiment).beforehand
    assert "2020-01-01 00:00 UTC" in lines(experiment)


WHOLE = planned([0, 1, 2])


@pytest.mark.parametrize(
    "trials, added",  # the baseline's first trials were there before the arm's first result
    [
        (planned([0, 1]), 3),
        (planned([0]), 6),
        (planned([0, 1, 2], ("adc",)), 6),
        ({key: seeds for key, seeds in WHOLE.items() if "garden" not in key}, 6),
        (WHOLE | {"garden/sfm-adc/c0ffee00": [0, 1]}, 1),
        ({key.replace("c0ff", "aaaa"): seeds for key, seeds in WHOLE.items()}, 9),
        ({}, 9),
    ],
)
@pytest.mark.parametrize("recorded", [True, False], ids=["by a command", "past the record"])
def test_a_metric_whose_trials_were_added_after_results_is_adjusted_with_all_others(
    tmp_path, trials, added, recorded
):
    """A later command recorded the additions, or the trials came without a record."""
    experiment = declared_experiment(tmp_path, effect=CLEAR, views=3)
    declare_trials(tmp_path, (EARLY, trials), *([(LATE, WHOLE)] if recorded else []))
    (one,) = judged(experiment)
    assert {(one.role(verdict), verdict.family) for verdict in one.verdicts} == {("", 4)}
    were = "trials were" if added > 1 else "trial was"
    words = f"{added} {were} added after the arm's first result"
    assert any(words in note for note in build_table(experiment).notes)


def test_the_report_says_that_trials_were_added(tmp_path):
    experiment = declared_experiment(tmp_path, effect=CLEAR, views=3)
    declare_trials(tmp_path, (EARLY, planned([0, 1])))
    page = build_report(experiment)
    assert "3 trials were added after the arm&#39;s first result" in page
    assert "declared beforehand." not in page
    assert "all metrics of a pair of arms are one family, 4 tests adjusted by Holm." in page


def test_declared_trials_that_are_missing_are_counted(tmp_path):
    experiment = declared_experiment(tmp_path, effect=CLEAR)
    declare_trials(tmp_path, (EARLY, planned([0, 1, 2, 3])))
    assert standing(experiment).beforehand
    (line,) = texts(compare(experiment).remarks)
    assert "Still missing: 4 of the 16 declared trials" in line
    assert line in build_report(experiment)


def test_a_record_that_was_deleted_and_written_anew_does_not_hide_added_trials(tmp_path):
    """Results repeat the declared metric and its time, but not the declared trials."""
    for path in write_runs(tmp_path, Plan(effect=CLEAR)):
        data = json.loads((path / "results.json").read_text())
        measured = EARLY if path.name.endswith(("seed0", "seed1")) else "2021-01-01T00:00:00Z"
        declared = {"metric": "lpips_vgg_raw", "time": "2019-01-01T00:00:00Z"}
        (path / "results.json").write_text(
            json.dumps(data | {"measured": measured, "declared": declared})
        )
    declare_trials(tmp_path, ("2020-06-01T00:00:00Z", planned([0, 1, 2])))
    found = standing(load_experiment(tmp_path, "exp"))
    assert len(found.added) == 4
    assert not found.beforehand


def test_a_record_may_name_no_trials_and_a_damaged_record_declares_nothing(tmp_path):
    experiment = declared_experiment(tmp_path, ("psnr", EARLY))
    assert standing(experiment).beforehand
    for trials in ({"a": [0]}, {"a/b/c/d": [0]}, {"a/b/c": 3}, {"a/b/d": ["x"]}):
        declare_trials(tmp_path, (EARLY, trials), metric="psnr")
        # a damaged line declares nothing
        assert active_declaration(replace(experiment)) is None


def test_declarations_are_read_back_as_they_were_written(tmp_path):
    arms = Arm("sfm", "adc"), Arm("sfm", "volumetric", (("densify.max_gaussians", "30000"),))
    keys = ("garden/sfm-adc/3fa9c1d2", "garden/sfm-volumetric/aaaaaaaa")
    asked = Question(
        metric="psnr",
        least=0.1,
        baseline=arms[0],
        arm=arms[1],
        scenes={"garden": keys},
        seeds=(0, 1, 2),
    )
    one = Declaration(time=EARLY, questions=(asked,), looks=(2, 3))
    two = Declaration(
        time=LATE, questions=(Question(metric="flip", sign=0),), trials={keys[0]: (0, 1)}
    )
    (tmp_path / "declared.jsonl").write_text(record_text([two, one]))
    assert read_declarations(tmp_path) == [one, two]
    assert one.planned == dict.fromkeys(keys, (0, 1, 2))
    assert one.kind == "sweep"
    assert str(arms[1]) == "sfm-volumetric[max_gaussians=30000]"


def test_the_verdict_on_a_sweep_in_looks_is_that_of_its_looks(tmp_path):
    experiment = declared_experiment(tmp_path, effect=CLEAR)
    scenes = {
        scene: (f"{scene}/sfm-adc/c0ffee00", f"{scene}/sfm-volumetric/c0ffee00")
        for scene in ("courtyard", "garden")
    }
    arms = Arm("sfm", "adc"), Arm("sfm", "volumetric")
    asked = Question(
        metric="lpips_vgg_raw",
        sign=-1,
        least=0.005,
        baseline=arms[0],
        arm=arms[1],
        scenes=scenes,
        seeds=(0, 1, 2),
    )
    declared = Declaration(time=EARLY, questions=(asked,), looks=(2, 3))
    (tmp_path / "exp" / "declared.jsonl").write_text(record_text([declared]))
    (one,) = judged(experiment)
    assert one.role(one.verdicts[0]) == "declared"
    assert one.verdicts[0].outcome == "supported"
    assert one.verdicts[0].p is None
    assert any("look" in line for line in families([one]))
    page = build_report(experiment)
    assert page.count("better in LPIPS VGG raw") == 1
    seeds = one.verdicts[0].pairs.seeds
    assert f"with {seeds} of at most 3 seeds. The metric was declared beforehand." in page
    # A look waits for the same seeds of both arms, and without pairs nothing is equal.
    lost = next((tmp_path / "exp/garden/sfm-adc").glob("*-seed1"))
    shutil.rmtree(lost)
    answers = compare(load_experiment(tmp_path, "exp"))
    assert (
        "no verdict yet, not all of the first 2 seeds are there in both arms"
        in (answers.sentences[0])
    )
    assert "there are no more of garden" in str(answers.unused[0])
