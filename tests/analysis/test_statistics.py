"""The statistics against scipy, hand-counted cases, and simulated sweeps with and without an effect."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import scipy.stats

from gsbench.analysis.pairing import Paired, ViewCache, choose_pairs, pair_arms
from gsbench.analysis.power import seeds_needed
from gsbench.analysis.results import Experiment
from gsbench.analysis.statistics import (
    ALPHA,
    THESE_SCENES,
    THIS_SCENE,
    Comparison,
    compare,
    compare_family,
    holm,
    pooled_deviation,
    student,
)
from gsbench.errors import InputError

ADC, VOLUMETRIC = ("sfm", "adc"), ("sfm", "volumetric")


def simulate(
    rng: np.random.Generator,
    scenes: int,
    trials: int,
    views: int,
    effect: float = 0.0,
    scene_noise: float = 0.0,
    trial_noise: float = 0.1,
    view_noise: float = 0.1,
    residual: float = 0.1,
) -> Paired:
    """Differences of a sweep in which trials, views and scenes each have an effect of their own."""
    matrices = tuple(
        effect
        + rng.normal(0, scene_noise)
        + rng.normal(0, trial_noise, (trials, 1))
        + rng.normal(0, view_noise, (1, views))
        + rng.normal(0, residual, (trials, views))
        for _ in range(scenes)
    )
    return Paired("psnr", tuple(f"s{k}" for k in range(scenes)), matrices, 25.0, ())


# --- building blocks


def test_the_test_of_one_scene_is_the_paired_t_test() -> None:
    values = np.array([0.3, 0.1, 0.25, 0.4])
    found, expected = student([values]), scipy.stats.ttest_1samp(values, 0)
    assert found is not None
    assert found.p == pytest.approx(expected.pvalue, rel=1e-9)
    for level in (0.95, 0.998):
        interval = found.interval(1 - level)
        assert (interval.low, interval.high) == pytest.approx(expected.confidence_interval(level))
    assert student([np.array([0.3])]) is None


def test_of_several_scenes_pairs_are_the_units_and_scenes_weigh_alike() -> None:
    rows = [np.array([0.3, 0.1, 0.2]), np.array([0.5, 0.4, 0.3])]
    found, expected = student(rows), scipy.stats.ttest_1samp(np.concatenate(rows), 0)
    assert found is not None
    assert (found.p, found.degrees) == (pytest.approx(expected.pvalue), 5)
    # By hand: the mean of 0.2 and 1.0, and weights 1/4, 1/4, 1/2.
    uneven = student([np.array([0.1, 0.3]), np.array([1.0])])
    assert uneven is not None
    assert uneven.mean == pytest.approx(0.6)
    assert uneven.error == pytest.approx(np.std([0.1, 0.3, 1.0], ddof=1) * (3 / 8) ** 0.5)


def test_the_pooled_deviation_ignores_the_level_of_a_scene() -> None:
    # Squared deviations 0.02 and 0.02 about each scene's own mean, over 2 degrees of freedom.
    assert pooled_deviation([np.array([1.0, 1.2]), np.array([5.0, 5.2])]) == pytest.approx(0.02**0.5)


def test_holm_is_step_down_and_monotone() -> None:
    # Textbook case: 0.01 x 4, 0.02 x 3, 0.03 x 2, 0.04 x 1, with the running maximum.
    assert holm([0.04, 0.01, None, 0.03, 0.02]) == [
        pytest.approx(x) if x else None for x in (0.06, 0.04, None, 0.06, 0.06)
    ]
    assert holm([0.9, 0.8]) == [1.0, 1.0]


# --- p and interval are one, and the method never changes


def zero_is_outside(comparison: Comparison) -> tuple[bool, bool]:
    """(p below 5 %, zero outside the interval)"""
    assert comparison.p_family is not None
    assert comparison.interval is not None
    return comparison.p_family < ALPHA, comparison.interval.excludes_zero()


@pytest.mark.parametrize("seed", range(20))
def test_an_interval_leaves_zero_out_exactly_where_p_is_below_5_percent(seed: int) -> None:
    """Of families of all sizes, scenes and seeds, and of every single scene, too."""
    rng = np.random.default_rng(seed)
    size, scenes, trials = (int(n) for n in rng.integers((1, 1, 2), (25, 9, 5)))
    members = [(simulate(rng, scenes, trials, 4, effect=rng.normal(0, 0.2)), 1) for _ in range(size)]
    for one in compare_family(members):
        decided, outside = zero_is_outside(one)
        assert decided == outside == (one.verdict != "no evidence")
        for scene in one.scenes:
            assert scene.p_family is not None
            assert scene.interval is not None
            assert (scene.p_family < ALPHA) == scene.interval.excludes_zero()


def test_of_one_scene_the_scene_and_the_whole_have_one_answer() -> None:
    rng = np.random.default_rng(2)
    members = [(simulate(rng, scenes, 3, 5, effect=0.3), 1) for scenes in (1, 1, 3)]
    for one in compare_family(members)[:2]:
        (scene,) = one.scenes
        assert (scene.p_family, scene.interval, scene.mean) == (one.p_family, one.interval, one.mean)


def test_views_do_not_move_p_or_interval() -> None:
    """The published files hold one value a trial: with the views at hand the answer must be the same."""
    whole = simulate(np.random.default_rng(3), 3, 3, 8)
    means = tuple(matrix.mean(axis=1, keepdims=True) for matrix in whole.differences)
    one, other = compare(whole, 1), compare(Paired("psnr", whole.scenes, means, 25.0, ()), 1)
    assert (one.p, one.interval) == (other.p, other.interval)


@pytest.mark.parametrize("family", [1, 2, 4, 20, 76])
def test_fewer_scenes_are_never_surer_where_scenes_do_not_differ(family: int) -> None:
    """Each scene has the same three differences, so only the amount of data falls; no number of tests may matter."""
    matrix = np.array([[0.5], [1.0], [1.8]])
    p_values = []
    for scenes in range(12, 0, -1):
        paired = Paired("m", tuple(map(str, range(scenes))), (matrix,) * scenes, 25.0, ())
        found = compare_family([(paired, 1)] * family)[0]
        assert found.test == f"Student's t over {3 * scenes} pairs of trials"
        assert found.p == compare(paired, 1).p
        p_values.append(found.p_family)
    assert p_values == sorted(p_values)


def test_a_sixth_scene_adds_a_question_and_takes_none_away() -> None:
    """Scenes with effects of their own: six do not speak for others, and leaving one out does not change that."""
    levels = (0.2, 2.2, 0.1, 0.9, 0.1, 0.2)
    scenes = tuple(level + np.array([[-0.1], [0.0], [0.1]]) for level in levels)
    six = compare(Paired("m", tuple("abcdef"), scenes, 25.0, ()), 1)
    five = compare(Paired("m", tuple("abcde"), scenes[:5], 25.0, ()), 1)
    assert five.beyond is None
    assert six.beyond is not None
    assert six.beyond.p == pytest.approx(scipy.stats.ttest_1samp(levels, 0).pvalue)
    assert (six.verdict, six.beyond.holds) == ("better", False)
    assert (six.scope, five.scope) == (THESE_SCENES, THESE_SCENES)


def test_what_does_not_hold_here_does_not_hold_for_others() -> None:
    """Scenes' means are alike by chance while their trials scatter: scenes alone would be sure."""
    scenes = tuple(1.0 + np.array([[-4.0], [0.0], [4.0]]) + 0.01 * k for k in range(6))
    found = compare(Paired("m", tuple("abcdef"), scenes, 25.0, ()), 1)
    assert scipy.stats.ttest_1samp([matrix.mean() for matrix in scenes], 0).pvalue < 1e-6
    assert found.beyond is not None
    assert found.beyond.p == found.p
    assert (found.verdict, found.beyond.holds) == ("no evidence", False)


# --- which question is answered


@pytest.mark.parametrize(
    ("scenes", "trials", "scope", "test"),
    [
        (1, 3, THIS_SCENE, "Student's t over 3 pairs"),
        (2, 3, THESE_SCENES, "Student's t over 6 pairs"),
        (6, 1, THESE_SCENES, "Student's t over 6 pairs"),
    ],
)
def test_the_unit_of_the_test_is_named(scenes: int, trials: int, scope: str, test: str) -> None:
    result = compare(simulate(np.random.default_rng(0), scenes, trials, 5), 1)
    assert result.scope == scope
    assert test in result.test


def test_one_trial_of_one_scene_is_no_evidence_however_large() -> None:
    result = compare(simulate(np.random.default_rng(0), 1, 1, 50, effect=100.0), 1)
    assert (result.p, result.interval, result.verdict) == (None, None, "no evidence")


def test_many_views_do_not_replace_trials() -> None:
    """The three trials disagree in sign; 400 views that agree with each other must not hide that."""
    matrix = np.array([[1.0], [-0.8], [0.3]]) + np.random.default_rng(0).normal(0, 0.01, (3, 400))
    pooled = scipy.stats.ttest_1samp(matrix.ravel(), 0).pvalue
    result = compare(Paired("psnr", ("s",), (matrix,), 25.0, ()), 1)
    assert pooled < 1e-6
    assert result.verdict == "no evidence"


@pytest.mark.parametrize(("direction", "verdict"), [(1, "better"), (-1, "worse")])
def test_a_clear_effect_gets_its_verdict_and_size(direction: int, verdict: str) -> None:
    result = compare(simulate(np.random.default_rng(1), 8, 3, 10, effect=1.0, scene_noise=0.1), direction)
    assert result.verdict == verdict
    assert result.interval.low < result.mean < result.interval.high
    assert result.mean == pytest.approx(1.0, abs=0.15)
    assert result.relative == pytest.approx(result.mean / 25.0)
    assert result.effect_size > 3
    assert all(scene.better_views == (direction > 0) for scene in result.scenes)


# --- simulated sweeps

SIMULATIONS = 400
LIMIT = 0.05 + 3 * (0.05 * 0.95 / SIMULATIONS) ** 0.5  # three standard errors above the stated rate


@pytest.mark.parametrize(
    ("scenes", "trials", "scene_noise"), [(1, 3, 0.0), (2, 3, 0.0), (1, 8, 0.0), (5, 2, 0.0), (7, 3, 0.2), (13, 3, 0.1)]
)
def test_false_verdicts_stay_at_the_stated_rate(scenes: int, trials: int, scene_noise: float) -> None:
    """About these scenes and views, or, where scenes have effects of their own, about scenes like these."""
    rng = np.random.default_rng(42)
    wrong = covered = 0
    for _ in range(SIMULATIONS):
        result = compare(simulate(rng, scenes, trials, 8, scene_noise=scene_noise, view_noise=0.0), 1)
        wrong += result.beyond.holds if scene_noise else result.verdict != "no evidence"
        covered += scene_noise > 0 or result.interval.low <= 0 <= result.interval.high
    assert wrong / SIMULATIONS < LIMIT
    assert covered / SIMULATIONS > 1 - LIMIT


def test_holm_holds_the_rate_of_any_false_scene() -> None:
    rng = np.random.default_rng(7)
    results = [compare(simulate(rng, 5, 3, 8, view_noise=0.0), 1) for _ in range(SIMULATIONS)]
    assert np.mean([any(scene.p_family < 0.05 for scene in result.scenes) for result in results]) < LIMIT
    assert np.mean([any(scene.p < 0.05 for scene in result.scenes) for result in results]) > 0.12  # without it, 23 %


def test_a_known_effect_is_found() -> None:
    rng = np.random.default_rng(5)
    found = [compare(simulate(rng, 2, 3, 8, effect=0.4, view_noise=0.05), 1).verdict for _ in range(200)]
    assert found.count("better") > 180
    assert "worse" not in found


def test_seeds_needed_give_the_promised_power() -> None:
    seeds = seeds_needed(deviation=0.1, scenes=2, difference=0.1)
    rng = np.random.default_rng(0)

    def power(count: int) -> float:
        samples = rng.normal(0.1, 0.1, (3000, 2, count))
        return float(np.mean([student(list(sample)).p < 0.05 for sample in samples]))

    assert power(seeds) == pytest.approx(0.85, abs=0.06)  # at least 80 %
    assert power(seeds) > 0.78
    assert power(seeds - 1) < 0.8


def test_seeds_needed_has_limits() -> None:
    assert seeds_needed(0.0, 1, 0.1) == 2
    assert seeds_needed(100.0, 1, 0.001) is None


# --- pairing


def test_pairs_share_scene_seed_and_view(make_experiment: Callable[..., Experiment]) -> None:
    experiment = make_experiment(effect={"psnr": 0.7}, trial_noise=0.0, residual_noise=0.0, view_noise=3.0)
    paired = pair_arms(experiment.trials, ADC, VOLUMETRIC, "psnr", ViewCache())
    assert paired.scenes == ("courtyard", "garden")
    # All noise is shared by the arms: paired, every single difference is the effect.
    assert all(np.allclose(matrix, 0.7) and matrix.shape == (3, 6) for matrix in paired.differences)


def test_what_has_no_partner_is_named(make_experiment: Callable[..., Experiment]) -> None:
    experiment = make_experiment()
    trials = [t for t in experiment.trials if (t.scene, t.densify, t.seed) != ("garden", "adc", 1)]
    damaged = next(t for t in trials if (t.scene, t.densify, t.seed) == ("courtyard", "adc", 0))
    (damaged.path / "per_view.csv").write_text("view,psnr\n")
    paired = pair_arms(trials, ADC, VOLUMETRIC, "psnr", ViewCache())
    assert paired.scenes == ("garden",)
    assert "garden: seed 1 has no partner" in paired.left_out
    assert any("per_view.csv" in line for line in paired.left_out)


def test_arms_under_different_conditions_are_not_compared(make_experiment: Callable[..., Experiment]) -> None:
    experiment = make_experiment()
    for trial in experiment.trials:
        if trial.densify == "adc":
            object.__setattr__(trial.record, "iterations", 7000)
    with pytest.raises(InputError, match="the arms differ in iterations"):
        pair_arms(experiment.trials, ADC, VOLUMETRIC, "psnr", ViewCache())


def test_comparisons_worth_making() -> None:
    arms = [("dim", "adc"), ("dim", "volumetric"), ("sfm", "adc"), ("sfm", "volumetric")]
    assert choose_pairs(arms) == [(arms[0], arms[1]), (arms[2], arms[3])]
    assert choose_pairs([("a", "x"), ("b", "x"), ("c", "x")]) == [(("a", "x"), ("b", "x")), (("a", "x"), ("c", "x"))]
    assert choose_pairs(arms[2:], baseline="volumetric") == [(arms[3], arms[2])]
    assert choose_pairs([("sfm", "adc")]) == []


def test_variants_are_held_against_the_baselines_own() -> None:
    arms = [("sfm", f"{name} cap={cap}") for name in ("adc", "volumetric") for cap in (1, 2)]
    assert choose_pairs(arms) == [(arms[0], arms[2]), (arms[1], arms[3])]
    arms = [("sfm", "adc"), ("sfm", "volumetric threshold=1"), ("sfm", "volumetric threshold=2")]
    assert choose_pairs(arms) == [(arms[0], arms[1]), (arms[0], arms[2])]
