"""`pair` and `judge` on trials in files: pairs, trials that are left out, and outcomes."""

import statistics
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gsbench.analysis.designs import seeds_needed
from gsbench.analysis.judgement import _contradicts, find_outlying, judge
from gsbench.analysis.notes import texts
from gsbench.analysis.pairing import Pairs, choose_pairs, pair
from gsbench.analysis.results import read_experiment
from gsbench.analysis.statistics import answer_family
from gsbench.analysis.unfinished import unfinished
from gsbench.analysis.verdict_words import outlying_words
from gsbench.analysis.verdicts import judge_pairs, seeds_to_resolve
from gsbench.runs.experiments import Arm, Declaration, Question
from gsbench.runs.trial_record import Budget
from tests.analysis.helpers import ADC, EARLY, LATE, VOLUMETRIC
from tests.analysis.untruths import scene_pairs

PSNR = Question(metric="psnr", least=0.1, baseline=ADC, arm=VOLUMETRIC)


def judged(trials, *questions, time=EARLY, **more):
    return judge(trials, Declaration(time=time, questions=questions), **more)


def named(trials, seeds=(0, 1, 2)):
    """The question that names these trials by their folders."""
    keys = {(trial.scene, trial.densify): trial.key for trial in trials}
    scenes = {scene: (keys[scene, "adc"], keys[scene, "volumetric"]) for scene, _ in keys}
    return replace(PSNR, scenes=scenes, seeds=seeds, name="claim")


def test_pairs_share_scene_and_seed(make_experiment):
    trials = make_experiment(effect={"psnr": 0.7}, trial_noise=0.0, residual_noise=0.0).trials
    found = pair(trials, PSNR)
    assert found.scenes == ("courtyard", "garden")
    assert found.differences.shape == (2, 3)
    assert np.allclose(found.differences, 0.7)  # all noise is shared by the arms
    assert pair(trials, named(trials)).differences.tolist() == found.differences.tolist()


def test_seeds_without_a_partner_are_named_and_all_scenes_keep_equally_many(make_experiment):
    trials = [
        t for t in make_experiment().trials if (t.scene, t.densify, t.seed) != ("garden", "adc", 1)
    ]
    found = pair(trials, PSNR)
    assert "garden: seed 1 has no partner" in texts(found.left_out)
    assert (
        "2 seeds of each scene can count: there are no more of garden (others have up to 3)"
        in texts(found.left_out)
    )
    assert found.differences.shape == (2, 2)
    assert len(found.trials) == 8


def test_planned_seeds_after_the_first_missing_one_do_not_count(make_experiment):
    trials = make_experiment().trials
    kept = [t for t in trials if (t.scene, t.densify, t.seed) != ("garden", "adc", 1)]
    assert pair(kept, named(trials)).seeds == 1


def with_adc(trials, **values):
    """The trials, with these values in the records of one arm."""
    return [
        replace(one, record=replace(one.record, **values)) if one.densify == "adc" else one
        for one in trials
    ]


def test_arms_under_different_conditions_are_not_compared(make_experiment):
    found = pair(with_adc(make_experiment().trials, iterations=7000), PSNR)
    assert not found.rows
    reason = "the arms differ in iterations, so they are not compared"
    assert texts(found.left_out) == [f"courtyard: {reason}", f"garden: {reason}"]


def test_a_seed_that_an_arm_has_twice_is_not_compared(make_experiment):
    trials = make_experiment(scenes=("garden",)).trials
    found = pair([*trials, trials[0]], PSNR)
    assert not found.rows
    assert "scene=garden sfm-adc has seed 0 twice" in str(found.left_out[0])


def test_budgets_may_differ_if_the_question_names_its_trials(make_experiment):
    budget = Budget(max_gaussians=7, cap="hard")
    trials = with_adc(make_experiment().trials, budget=budget)
    assert pair(trials, named(trials)).seeds == 3
    assert not pair(trials, PSNR).rows


def test_relative_differences_are_means_of_logarithms(make_experiment):
    trials = make_experiment().trials
    question = replace(named(trials), metric="gaussians", relative=True, least=0.1)
    (verdict,) = judged(trials, question)
    counts = {(t.scene, t.densify, t.seed): t.record.num_gaussians for t in trials}
    ratios = [
        counts[s, "volumetric", k] / counts[s, "adc", k]
        for s in ("courtyard", "garden")
        for k in range(3)
    ]
    assert verdict.mean == pytest.approx(np.mean(np.log(ratios)))
    assert verdict.shown(np.log(1.284)) == "+28.4 %"


@pytest.mark.parametrize("densify", ["adc", "volumetric"])
def test_no_ratio_is_taken_of_a_value_of_zero(make_experiment, densify):
    trials = make_experiment(scenes=("garden",)).trials
    for trial in trials:
        if (trial.densify, trial.seed) == (densify, 1):
            trial.record.metrics["psnr"] = 0.0
    assert pair(trials, PSNR).seeds == 3
    assert pair(trials, replace(PSNR, metric="ssim", relative=True)).seeds == 3  # all below one
    found = pair(trials, replace(PSNR, relative=True))
    assert found.rows[0].seeds == (0, 2)
    assert "garden seed 1 not compared: PSNR (dB) is 0, and a ratio needs numbers above 0" in texts(
        found.left_out
    )


def test_a_look_waits_for_every_scene_and_the_first_that_decides_is_final(make_experiment):
    trials = make_experiment(effect={"psnr": 3.0}).trials
    declared = Declaration(time=EARLY, questions=(named(trials),), looks=(2, 3))
    (whole,) = judge(trials, declared)
    assert (whole.outcome, whole.final) == ("supported", True)
    first = [trial for trial in trials if trial.seed == 0]
    (waits,) = judge(first, declared)
    assert (waits.outcome, waits.final, waits.answer) == ("undecided", False, None)
    (nothing,) = judge([trial for trial in trials if trial.scene == "garden"], declared)
    assert not nothing.final
    later = [trial for trial in trials if trial.seed < whole.pairs.seeds]
    assert judge(later, declared)[0].interval == whole.interval


def test_trials_measured_before_the_question_divide_its_error_rate(make_experiment):
    trials = make_experiment(effect={"psnr": 3.0}).trials
    one, late = (
        judge(trials, Declaration(time=t, questions=(named(trials),), looks=(3,)))[0]
        for t in (EARLY, LATE)
    )
    assert (len(one.seen), len(late.seen)) == (0, 6)  # the baseline's trials may be older
    # psnr, ssim, flip and one LPIPS
    assert late.answer.level == pytest.approx(one.answer.level / 4)


@pytest.mark.parametrize("seeds", [1, 2, 3])
def test_a_scene_has_the_mean_and_the_deviation_of_its_differences(make_experiment, seeds):
    trials = make_experiment(seeds=range(seeds)).trials
    (verdict,) = judged(trials, PSNR)
    assert [scene.scene for scene in verdict.scenes] == ["courtyard", "garden"]
    spread = np.sqrt(verdict.pairs.differences.var(axis=1, ddof=1).mean()) if seeds > 1 else None
    assert verdict.deviation == (pytest.approx(spread) if seeds > 1 else None)
    resolving = None if spread is None else seeds_needed(spread, 2, 0.1)  # 0.1 dB
    assert seeds_to_resolve(verdict) == resolving
    any_size = replace(verdict, quantity=replace(verdict.quantity, worthwhile=None))
    assert seeds_to_resolve(any_size) is None
    values = {(trial.scene, trial.densify, trial.seed): trial.metrics["psnr"] for trial in trials}
    for found in verdict.scenes:
        own = [
            values[found.scene, "volumetric", seed] - values[found.scene, "adc", seed]
            for seed in range(seeds)
        ]
        assert found.seeds == seeds
        assert found.mean == pytest.approx(statistics.mean(own))


def test_arms_that_never_differ_cannot_be_tested(make_experiment):
    trials = make_experiment().trials
    for trial in trials:
        object.__setattr__(trial.record, "metrics", {"psnr": 20.0})
        object.__setattr__(trial.record, "num_gaussians", 5)
    (verdict,) = judge(trials, Declaration(time=EARLY, questions=(named(trials),), looks=(2, 3)))
    assert "equal to the last bit" in str(verdict.untestable)
    assert verdict.final


# --- trials far outside the others


def rows(before, after):
    both = (np.array([b, a]) for b, a in zip(before, after, strict=True))
    return Pairs(tuple(scene_pairs(place, noise, 0.0) for place, noise in enumerate(both)))


def test_an_outlying_training_is_found():
    good = [[20.0, 20.1, 19.9, 20.05]] * 2
    found = find_outlying(rows(good, [[20.5, 20.6, 10.0, 20.4], [20.5, 20.4, 20.6, 20.5]]))
    assert [trial.path for trial in found] == [Path("0/b2")]
    assert find_outlying(rows(good, good)) == []
    # The other arm's deviation of 1, times 1.2 for being that of three trials, counts five times.
    even = [[-1.0, 0.0, 1.0]]
    for far, found in ((5.9, []), (6.1, [Path("0/b2"), Path("0/a2")])):
        uneven = [[0.0, 0.0, far]]
        both = *find_outlying(rows(even, uneven)), *find_outlying(rows(uneven, even))
        assert [one.path for one in both] == found
    # of two trials, it is not known which one failed
    assert find_outlying(rows([[20.0, 30.0]], [[20.0, 20.1]])) == []


def test_a_verdict_that_depends_on_one_training_is_undecided(make_experiment):
    """Without the training that failed the mean has the other sign."""
    trials = make_experiment(scenes=("a", "b", "c"), seeds=range(6)).trials
    values = {
        "adc": [20.0, 20.01, 19.99, 20.0, 20.01, 19.99],
        "volumetric": [20.02, 20.0, 20.01, 20.02, 20.0, 20.01],
    }
    for trial in trials:
        value = values[trial.densify][trial.seed] - (
            5.0 if trial.densify == "volumetric" and trial.seed == 5 else 0.0
        )
        object.__setattr__(trial.record, "metrics", {"psnr": value})
    (verdict,) = judged(trials, replace(PSNR, least=None))
    assert {trial.seed for trial in verdict.outlying} == {5}
    assert verdict.outcome == "undecided"
    assert verdict.outcome_without is not None


@pytest.mark.parametrize("effect", [3.0, -3.0, 0.0])
@pytest.mark.parametrize("metric, direction", [("psnr", 1), ("lpips_vgg_raw", -1)])
@pytest.mark.parametrize("lost", ["volumetric", "adc", "both", "foreign"])
def test_no_verdict_favours_an_arm_whose_trials_failed_alone(
    make_experiment, tmp_path, lost, metric, direction, effect
):
    """Only its good trainings may be left; against it, what is left is enough."""
    plan = {"seeds": range(4), "effect": {metric: direction * effect}, "scenes": tuple("abcdefg")}
    made = make_experiment(**plan, trial_noise=0.01, residual_noise=0.01)
    for trial in made.trials:
        if (trial.scene, trial.seed) == ("b", 2) and lost in (trial.densify, "both", "foreign"):
            (trial.path / "results.json").unlink()
            if lost == "foreign":
                (trial.path / "config.yaml").unlink()
            elif trial.densify == "adc":
                text = '{"type": "E", "message": "lost", "traceback": "", "time": 1}'
                (trial.path / "failed.json").write_text(text)
    asked = replace(PSNR, metric=metric, sign=direction, least=1.0)
    experiment = read_experiment(tmp_path / made.name)
    (verdict,) = judged(experiment.trials, asked, lacking=unfinished(experiment))
    outcome = {3.0: "supported", -3.0: "refuted", 0.0: "too small to matter"}[effect]
    undecided = lost in {3.0: ["volumetric"], -3.0: ["adc"], 0.0: ["volumetric", "adc"]}[effect]
    assert verdict.outcome == ("undecided" if undecided else outcome)
    assert verdict.favours_lacking == undecided
    assert verdict.like_these.outcome == verdict.outcome
    assert ("b/sfm-" in outlying_words(verdict)) == undecided
    without_test = [one.scene for one in verdict.scenes if one.p is None]
    assert without_test == ["b"] * (lost in ("volumetric", "adc"))


@pytest.mark.parametrize(
    "rest, outcome, least, expected",
    [
        (0.1, "supported", None, False),
        (0.0, "supported", None, True),
        (-0.1, "refuted", 0.5, True),
        (-0.1, "undecided", None, False),
        (0.4, "too small to matter", 0.5, False),
        (-0.5, "too small to matter", 0.5, True),
    ],
)
def test_a_mean_without_outlying_trials_may_contradict_the_outcome(rest, outcome, least, expected):
    assert _contradicts(rest, 0.2, outcome, least) == expected


def test_scenes_of_all_questions_are_one_family_and_a_single_scene_has_the_questions_answer(
    make_experiment,
):
    trials = make_experiment(scenes=("a", "b", "c"), effect={"psnr": 0.5}).trials
    questions = [named([t for t in trials if t.scene in scenes]) for scenes in ("a", "bc")]
    single, several = judged(trials, *questions)
    assert [scene.interval for scene in single.scenes] == [single.interval]
    expected = answer_family([row[None] for row in several.pairs.differences])
    assert [(scene.interval, scene.p) for scene in several.scenes] == [
        (one.interval, one.p) for one in expected
    ]


# --- which arms are compared


def test_arms_are_compared_with_the_baseline_of_the_same_initialiser():
    arms = [Arm("dim", "adc"), Arm("dim", "volumetric"), ADC, VOLUMETRIC]
    assert choose_pairs(arms) == [(arms[0], arms[1]), (arms[2], arms[3])]
    three = [Arm(init, "x") for init in "abc"]
    assert choose_pairs(three) == [(three[0], three[1]), (three[0], three[2])]
    assert choose_pairs(arms[2:], baseline="volumetric") == [(arms[3], arms[2])]
    assert choose_pairs([ADC]) == []


def test_variants_are_compared_with_the_baseline_of_the_same_settings():
    arms = [
        Arm("sfm", name, (("cap", str(cap)),)) for name in ("adc", "volumetric") for cap in (1, 2)
    ]
    assert choose_pairs(arms) == [(arms[0], arms[2]), (arms[1], arms[3])]
    arms = [ADC, *(Arm("sfm", "volumetric", (("threshold", str(k)),)) for k in (1, 2))]
    assert choose_pairs(arms) == [(arms[0], arms[1]), (arms[0], arms[2])]


def test_what_was_left_out_of_a_compared_pair_is_noted_for_each_metric(make_experiment):
    trials = make_experiment(scenes=("garden",)).trials
    kept = [trial for trial in trials if (trial.densify, trial.seed) != ("adc", 1)]
    (one,) = judge_pairs(kept, [(ADC, VOLUMETRIC)])
    assert len(one.verdicts) == len(one.notes) > 1
    assert str(one.notes[0]) == "PSNR (dB): garden: seed 1 has no partner"
