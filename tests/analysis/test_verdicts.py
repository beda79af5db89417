"""`judge` on trials in files: pairs, states, outcomes and guards, by hand."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from gsbench.analysis.notes import texts
from gsbench.analysis.pairs import Pairs, ScenePairs, pair
from gsbench.analysis.results import Unfinished, read_experiment
from gsbench.analysis.sentences import badge, in_words, reason, risk, sentence
from gsbench.analysis.verdicts import find_outlying, interval_of, judge
from gsbench.runs.trial_record import Budget
from tests.analysis.helpers import ADC, VOLUMETRIC
from tests.analysis.tables import TABLES
from tests.trials import ask_about, with_record, write_runs

BETTER = {"psnr": 3.0}


@pytest.fixture
def asked(tmp_path):
    """Trials of a plan and the one question about all of them."""

    def make(metric="psnr", looks=(), **plan):
        write_runs(tmp_path, **plan)
        (question,) = ask_about(tmp_path, metric=metric, looks=looks)
        return list(read_experiment(tmp_path / "exp").trials), question

    return make


def without(trials, *places):
    return [t for t in trials if (t.scene, t.densify, t.seed) not in places]


def lost(trials, place, **state):
    """The trial at this place as one without a result."""
    (trial,) = (t for t in trials if (t.scene, t.densify, t.seed) == place)
    return Unfinished(trial.path, trial.digest, **state)


def with_adc(trials, **values):
    """The trials, with these values in the records of one arm."""
    return [with_record(one, **values) if one.densify == "adc" else one for one in trials]


# ---- pairs


def test_pairs_share_scene_and_seed(asked):
    trials, question = asked(effect={"psnr": 0.7}, trial_noise=0.0, residual_noise=0.0)
    found = pair(trials, question)
    assert [row.scene for row in found.rows] == ["courtyard", "garden"]
    assert found.differences.shape == (2, 3)
    assert np.allclose(found.differences, 0.7)  # all noise is shared by the arms


def test_all_scenes_keep_equally_many_seeds(asked):
    trials, question = asked()
    found = pair(without(trials, ("garden", "adc", 1)), question)
    assert (
        "2 seeds of each scene can count: there are no more of garden (others have up to 3)"
        in texts(found.left_out)
    )
    assert found.differences.shape == (2, 2)
    assert len(found.trials) == 8


def test_in_looks_seeds_after_the_first_missing_one_do_not_count(asked):
    trials, question = asked(looks=(2, 3))
    assert pair(without(trials, ("garden", "adc", 1)), question).seeds == 1


def test_arms_under_different_conditions_are_not_compared(asked):
    trials, question = asked()
    verdict = judge(with_adc(trials, iterations=7000), question)
    assert "the arms differ in iterations, so they are not compared" in str(verdict.untestable)


def test_budgets_may_differ_only_if_the_question_has_a_name(asked):
    trials, question = asked()
    trials = with_adc(trials, budget=Budget(max_gaussians=7, cap="hard"))
    assert not pair(trials, question).rows
    assert pair(trials, replace(question, name="claim")).seeds == 3


def test_relative_differences_are_means_of_logarithms(asked):
    trials, question = asked()
    question = replace(question, metric="gaussians", relative=True, least=0.1)
    verdict = judge(trials, question)
    counts = {(t.scene, t.densify, t.seed): t.record.num_gaussians for t in trials}
    ratios = [
        counts[s, "volumetric", k] / counts[s, "adc", k]
        for s in ("courtyard", "garden")
        for k in range(3)
    ]
    assert verdict.mean == pytest.approx(np.mean(np.log(ratios)))
    assert verdict.shown(np.log(1.284)) == "+28.4 %"


def test_one_capture_under_two_names_is_one_scene(asked):
    trials, question = asked()
    same = [with_record(t, hashes=t.record.hashes | {"data": "one"}) for t in trials]
    assert "garden has the photographs of courtyard" in str(judge(same, question).untestable)


# ---- states and outcomes


def test_one_scene_is_decided_by_the_paired_t_test_at_the_level_of_the_question(asked):
    trials, question = asked(scenes=("garden",), effect={"psnr": 0.4})
    values = {(t.densify, t.seed): t.metrics["psnr"] for t in trials}
    differences = [values["volumetric", k] - values["adc", k] for k in range(3)]
    expected = stats.ttest_1samp(differences, 0)
    for level in (0.05, 0.0083):
        verdict = judge(trials, replace(question, level=level, n=3))
        interval = expected.confidence_interval(1 - level)
        assert (verdict.interval.low, verdict.interval.high) == pytest.approx(interval)
        assert (verdict.outcome == "supported") == (expected.pvalue < level)
        assert verdict.p == pytest.approx(expected.pvalue)


def test_trials_of_no_question_change_nothing(asked):
    trials, question = asked(effect=BETTER, seeds=(0, 1, 2))
    verdict = judge(trials, question)
    others = [replace(t, alias="sfm-other/1") for t in trials]
    assert sentence(judge([*trials, *others], question)) == sentence(verdict)


def test_there_is_no_verdict_before_all_trials_are_done_or_have_failed(asked):
    trials, question = asked(effect=BETTER)
    place = ("garden", "adc", 1)
    some = without(trials, place)
    for state, name in (({"running": True}, "RUNNING 11/12"), ({}, "STOPPED 11/12")):
        verdict = judge(some, question, [lost(trials, place, **state)])
        assert (badge(verdict), verdict.outcome, verdict.final) == (name, "undecided", False)
        assert verdict.mean == pytest.approx(3, abs=0.5)
    assert "to go on: gsbench retry exp" in sentence(verdict)
    failed = judge(some, question, [lost(trials, place, failed=True)])
    assert (badge(failed), failed.outcome) == ("BETTER", "supported")


def test_an_awaited_baseline_is_named(asked):
    trials, question = asked(scenes=("garden",))
    waits = judge([t for t in trials if t.densify != "adc"], question)
    assert badge(waits) == "STOPPED 3/6"
    assert "such as sfm-adc" in reason(waits)


def test_results_without_a_question_before_their_training_are_not_tested(asked):
    trials, question = asked(effect=BETTER)
    late = [with_record(t, questions=[]) if t.densify != "adc" else t for t in trials]
    verdict = judge(late, question)
    assert (badge(verdict), verdict.outcome) == ("NOT ASKED", "undecided")
    assert verdict.interval is not None
    older_baseline = with_adc(trials, questions=[])
    assert judge(older_baseline, question).outcome == "supported"


def test_a_question_that_left_something_out_shows_an_interval_alone(asked):
    trials, question = asked(effect=BETTER)
    verdict = judge(trials, replace(question, untested="it leaves out measured trials: x"))
    assert (badge(verdict), verdict.outcome) == ("NOT TESTED", "undecided")
    assert "not tested, since it leaves out measured trials: x" in in_words(verdict)


@pytest.mark.parametrize(
    "effect, sign, least, expected",
    TABLES["badges"],
)
def test_badges_say_the_outcome_in_the_direction_of_the_question(
    asked, effect, sign, least, expected
):
    trials, question = asked(effect={"psnr": effect})
    assert badge(judge(trials, replace(question, sign=sign, least=least))) == expected


def test_a_single_pair_has_no_test(asked):
    trials, question = asked(scenes=("garden",), seeds=(0,), effect=BETTER)
    verdict = judge(trials, question)
    assert (verdict.outcome, verdict.interval) == ("undecided", None)
    assert "one pair of trainings has no test" in reason(verdict)


def test_equal_bits_are_said(asked):
    trials, question = asked(scenes=("garden",))
    of_adc = {t.seed: t.record for t in trials if t.densify == "adc"}
    same = [
        replace(t, record=replace(of_adc[t.seed], densify=t.densify, questions=["x"]))
        for t in trials
    ]
    assert "equal to the last bit" in str(judge(same, question).untestable)


def test_all_scenes_must_agree_for_scenes_like_these_at_a_small_level(asked):
    trials, question = asked(scenes=tuple("abcdef"), effect=BETTER)
    at_five, at_less = (judge(trials, replace(question, level=x)) for x in (0.05, 0.0167))
    assert (at_five.like_these.outcome, at_five.like_these.needed) == ("supported", 6)
    assert (at_less.like_these.outcome, at_less.like_these.needed) == ("undecided", None)
    assert at_less.outcome == "supported"
    assert "so few scenes cannot decide it" in sentence(at_less)


def test_single_scenes_have_95_percent_intervals_whatever_the_level(asked):
    trials, question = asked()
    scenes = judge(trials, replace(question, level=0.001)).scenes
    assert scenes == judge(trials, question).scenes
    values = [
        [t.metrics["psnr"] for t in trials if (t.scene, t.densify) == ("garden", name)]
        for name in ("adc", "volumetric")
    ]
    expected = stats.ttest_1samp(np.subtract(values[1], values[0]), 0).confidence_interval(0.95)
    assert (scenes[1][3].low, scenes[1][3].high) == pytest.approx(expected)


# ---- looks


def test_a_look_waits_for_every_scene_and_the_first_that_decides_is_final(asked):
    trials, question = asked(effect=BETTER, looks=(2, 3), trial_noise=0.01, residual_noise=0.01)
    whole = judge(trials, question)
    assert (whole.outcome, whole.final, whole.pairs.seeds) == ("supported", True, 2)
    assert whole.level == pytest.approx(0.05 * 0.4)
    waits = judge([t for t in trials if t.seed == 0], question)
    assert (waits.outcome, waits.final, waits.test) == ("undecided", False, None)
    assert not judge([t for t in trials if t.scene == "garden"], question).final
    early = judge([t for t in trials if t.seed < 2], question)
    assert early.interval == whole.interval


def test_the_last_look_of_an_undecided_question_has_sixty_percent(asked):
    trials, question = asked(looks=(2, 3))
    last = judge(trials, replace(question, least=None))
    assert (last.outcome, last.final) == ("undecided", True)
    assert last.level == pytest.approx(0.05 * 0.6)


# ---- guards


@pytest.mark.parametrize("effect, loses", [(3.0, "volumetric"), (-3.0, "adc")])
def test_no_verdict_favours_an_arm_that_lacks_results(asked, effect, loses):
    trials, question = asked(effect={"psnr": effect}, scenes=tuple("abcdef"))
    place = ("a", loses, 1)
    verdict = judge(without(trials, place), question, [lost(trials, place, failed=True)])
    assert (verdict.outcome, verdict.favours_lacking) == ("undecided", True)
    assert verdict.like_these.outcome == "undecided"
    assert "perhaps its bad ones" in reason(verdict)
    other = ("a", {"adc": "volumetric", "volumetric": "adc"}[loses], 1)
    against = judge(without(trials, other), question, [lost(trials, other, failed=True)])
    assert against.outcome != "undecided"
    both = judge(
        without(trials, place, other),
        question,
        [lost(trials, one, failed=True) for one in (place, other)],
    )
    assert both.outcome != "undecided"


def test_a_missing_value_counts_as_a_missing_result(asked):
    trials, question = asked(effect=BETTER)
    for trial in trials:
        if (trial.scene, trial.densify, trial.seed) == ("garden", "volumetric", 1):
            del trial.record.metrics["psnr"]
    assert judge(trials, question).favours_lacking


def test_a_trial_far_outside_is_named_and_changes_nothing():
    close = [0.00, 0.01, 0.02, 0.03]
    trials = tuple((f"b{k}", f"a{k}") for k in range(4))
    far = ScenePairs("s", (0, 1, 2, 3), trials, np.array(close), np.array([5.0, *close[:3]]))
    assert find_outlying(Pairs((far,))) == ["a0"]
    near = replace(far, arm=np.array(close))
    assert find_outlying(Pairs((near,))) == []


# ---- intervals and risk


def test_any_two_arms_and_metric_have_an_interval_that_is_no_verdict(asked):
    trials, _ = asked(effect={"ssim": 0.2})
    found = interval_of(trials, ADC, VOLUMETRIC, "ssim")
    assert (found.mean, found.outcome) == (pytest.approx(0.2, abs=0.02), "undecided")
    assert found.interval.excludes_zero()
    assert badge(found) == "NOT TESTED"


def test_a_page_says_the_sum_of_its_levels(asked):
    trials, question = asked(scenes=tuple("abcdef"))
    verdict = judge(trials, replace(question, level=0.025))
    assert risk([verdict, verdict]) == (
        "2 questions, 4 statements; if none had an effect, at most 0.1 of them would be called "
        "better or worse."
    )
    assert risk([interval_of(trials, ADC, VOLUMETRIC, "ssim")]) == ""
