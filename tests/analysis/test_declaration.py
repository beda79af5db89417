"""Declared metrics: which tests are adjusted together, and what is said of late declarations."""

import calendar
import os
import shutil
import time
from dataclasses import replace

import pytest

from gsbench.analysis.comparison import compare
from gsbench.analysis.declaration import active_declaration
from gsbench.analysis.notes import texts
from gsbench.analysis.report.build import build_report
from gsbench.analysis.tables import build_table
from gsbench.analysis.verdict_words import families, in_words, p_text
from gsbench.runs.experiments import (
    STAMP,
    Declaration,
    Question,
    open_question,
    read_declarations,
    record_text,
)
from tests.analysis.helpers import ADC, EARLY, LATE, VOLUMETRIC, loaded, write_declared
from tests.helpers import change_json, write_lines
from tests.trials import write_runs

CLEAR = {"lpips_vgg_raw": -0.05}


def asking(metric, time=EARLY, **more):
    return Declaration(time=time, questions=(open_question(metric),), **more)


def declared_experiment(runs, *records, **plan):
    """An experiment with a declaration for each (metric, time)."""
    write_runs(runs, **plan)
    write_declared(runs, *(asking(*record) for record in records))
    return loaded(runs)


def judged(experiment):
    return list(compare(experiment).answers)


def standing(experiment):
    """How the declaration stands to the question about the only compared arm."""
    (one,) = judged(experiment)
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
    order = ["flip", "psnr", "ssim", "lpips_vgg_raw"]
    assert [verdict.quantity.key for verdict in one.verdicts] == order
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


# --- what report and table say


def test_the_report_says_what_was_declared_and_what_is_secondary(tmp_path):
    plan = {"effect": CLEAR, "views": 3, "random_seed": 1}
    page = build_report(declared_experiment(tmp_path, ("lpips_vgg_raw", EARLY), **plan))
    assert "LPIPS VGG raw was declared beforehand (eval.primary, 2020-01-01 00:00 UTC)." in page
    assert "sfm-volumetric against sfm-adc: better in LPIPS VGG raw on these scenes: −" in page
    assert "The metric was declared beforehand." in page
    assert "Secondary, adjusted for their number: undecided in" in page
    assert "Interval and p are adjusted" in page
    assert "no metric was declared" not in page


def test_without_a_declaration_all_metrics_are_one_family_and_the_report_says_so(make_experiment):
    experiment = make_experiment(effect=CLEAR, views=3)
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
    (verdict,) = verdict_notes(experiment)
    assert verdict.removeprefix("Verdict, ") in page


def verdict_notes(experiment, trials=None):
    notes = build_table(experiment, trials).notes
    return [note for note in notes if note.startswith("Verdict")]


def test_tables_have_the_verdict_on_the_declared_metric_whichever_trials_they_show(tmp_path):
    experiment = declared_experiment(tmp_path, ("lpips_vgg_raw", EARLY), effect=CLEAR)
    (whole,) = verdict_notes(experiment)
    assert whole.startswith(
        "Verdict, sfm-volumetric against sfm-adc: better in LPIPS VGG raw on these scenes: −0.05"
    )
    part = [trial for trial in experiment.trials if trial.scene == "garden"]
    assert verdict_notes(experiment, part) == [whole]


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
    assert f"no verdict, since {reason}" in verdict_notes(experiment)[0]


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
    paths = write_runs(tmp_path, scenes=("garden",))
    write_declared(tmp_path, asking("psnr", "2030-06-01T00:00:00Z"))
    after = calendar.timegm(time.strptime("2030-06-02T00:00:00Z", STAMP))
    for place, path in enumerate(paths):
        if place in OLDER:
            change_json(path / "results.json", measured="2030-05-31T00:00:00Z")
        os.utime(path / "results.json", (after, after))
    found = standing(loaded(tmp_path))
    assert [(one.name, one.seed) for one in found.seen] == [("sfm-volumetric", 0)]
    assert not found.beforehand


def test_a_declaration_is_read_from_trials_if_its_record_is_gone(tmp_path):
    path = write_runs(tmp_path)[0]
    change_json(path / "results.json", declared={"metric": "psnr", "time": EARLY})
    experiment = loaded(tmp_path)
    repeated = [trial.record.declared for trial in experiment.trials]
    assert [one.primary for one in read_declarations(experiment.folder, repeated)] == ["psnr"]
    assert read_declarations(tmp_path / "nothing") == []


# --- which trials were declared with it


def declare_trials(runs, *records, metric="lpips_vgg_raw"):
    entries = [asking(metric, time).to_json() | {"trials": trials} for time, trials in records]
    write_lines(runs / "exp/declared.jsonl", entries)


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


def test_declared_trials_that_are_missing_are_counted(tmp_path):
    experiment = declared_experiment(tmp_path, effect=CLEAR)
    declare_trials(tmp_path, (EARLY, planned([0, 1, 2, 3])))
    assert standing(experiment).beforehand
    (line,) = texts(compare(experiment).remarks)
    assert "Still missing: 4 of the 16 declared trials" in line
    assert line in build_report(experiment)


def test_a_record_that_was_deleted_and_written_anew_does_not_hide_added_trials(tmp_path):
    """Results repeat the declared metric and its time, but not the declared trials."""
    declared = {"metric": "lpips_vgg_raw", "time": "2019-01-01T00:00:00Z"}
    for path in write_runs(tmp_path, effect=CLEAR):
        measured = EARLY if path.name.endswith(("seed0", "seed1")) else "2021-01-01T00:00:00Z"
        change_json(path / "results.json", measured=measured, declared=declared)
    declare_trials(tmp_path, ("2020-06-01T00:00:00Z", planned([0, 1, 2])))
    found = standing(loaded(tmp_path))
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
    arm = replace(VOLUMETRIC, variant=(("densify.max_gaussians", "30000"),))
    keys = ("garden/sfm-adc/3fa9c1d2", "garden/sfm-volumetric/aaaaaaaa")
    asked = Question(metric="psnr", least=0.1, baseline=ADC, arm=arm, scenes={"garden": keys})
    one = Declaration(time=EARLY, questions=(replace(asked, seeds=(0, 1, 2)),), looks=(2, 3))
    two = asking("flip", LATE, trials={keys[0]: (0, 1)})
    (tmp_path / "declared.jsonl").write_text(record_text([two, one]))
    assert read_declarations(tmp_path) == [one, two]
    assert one.planned == dict.fromkeys(keys, (0, 1, 2))
    assert one.kind == "sweep"
    assert str(arm) == "sfm-volumetric[max_gaussians=30000]"


def test_the_verdict_on_a_sweep_in_looks_is_that_of_its_looks(tmp_path):
    experiment = declared_experiment(tmp_path, effect=CLEAR)
    asked = Question(
        metric="lpips_vgg_raw",
        sign=-1,
        least=0.005,
        baseline=ADC,
        arm=VOLUMETRIC,
        scenes={
            scene: tuple(f"{scene}/{arm}/c0ffee00" for arm in (ADC, VOLUMETRIC))
            for scene in ("courtyard", "garden")
        },
        seeds=(0, 1, 2),
    )
    write_declared(tmp_path, Declaration(time=EARLY, questions=(asked,), looks=(2, 3)))
    (one,) = judged(experiment)
    first = one.verdicts[0]
    assert (one.role(first), first.outcome, first.p) == ("declared", "supported", None)
    assert any("look" in line for line in families([one]))
    page = build_report(experiment)
    assert page.count("better in LPIPS VGG raw") == 1
    said = f"with {first.pairs.seeds} of at most 3 seeds. The metric was declared beforehand."
    assert said in page
    # A look waits for the same seeds of both arms, and without pairs nothing is equal.
    shutil.rmtree(tmp_path / "exp/garden/sfm-adc/c0ffee00-seed1")
    answers = compare(loaded(tmp_path))
    said = "no verdict yet, not all of the first 2 seeds are there in both arms"
    assert said in answers.sentences[0]
    assert "there are no more of garden" in str(answers.unused[0])
