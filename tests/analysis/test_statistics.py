"""The statistics against scipy, hand-counted cases, and simulated sweeps with and without an effect."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import scipy.stats

from gsbench.analysis.pairing import Paired, ViewCache, choose_pairs, pair_arms
from gsbench.analysis.results import Experiment
from gsbench.analysis.statistics import (
    SCENES_LIKE_THESE,
    THESE_SCENES,
    THIS_SCENE,
    bootstrap_interval,
    compare,
    holm,
    pooled_deviation,
    seeds_needed,
    sign_flip_p,
    stratified_t_p,
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


def test_sign_flips_are_counted_exactly() -> None:
    # All six of one sign: only two of 64 patterns are as extreme.
    assert sign_flip_p(np.array([1.0, 2, 3, 4, 5, 6]), np.ones(6)) == 2 / 64
    # Sums of (±1 ±2 ±4): 7, 5, 3, 1 and their negatives; -1 + 2 + 4 = 5 is reached or passed by 4 of 8.
    assert sign_flip_p(np.array([-1.0, 2, 4]), np.ones(3)) == 4 / 8
    assert sign_flip_p(np.zeros(6), np.ones(6)) == 1.0


@pytest.mark.parametrize("n", [5, 9])
def test_sign_flips_match_scipy(n: int) -> None:
    values = np.random.default_rng(n).normal(0.3, 1, n)
    expected = scipy.stats.permutation_test(
        (values, np.zeros(n)),
        lambda a, b, axis: np.mean(a - b, axis=axis),
        permutation_type="samples",
        vectorized=True,
        n_resamples=np.inf,
    ).pvalue
    assert sign_flip_p(values, np.ones(n)) == pytest.approx(expected, abs=1e-12)


def test_random_flips_of_many_units_are_close_to_the_t_test() -> None:
    values = np.random.default_rng(0).normal(0.4, 1, 40)
    assert sign_flip_p(values, np.ones(40)) == pytest.approx(scipy.stats.ttest_1samp(values, 0).pvalue, abs=0.005)


def test_the_stratified_t_test_of_one_scene_is_the_paired_t_test() -> None:
    values = np.array([0.3, 0.1, 0.25, 0.4])
    assert stratified_t_p([values]) == pytest.approx(scipy.stats.ttest_1samp(values, 0).pvalue, rel=1e-9)
    assert stratified_t_p([np.array([0.3])]) is None


def test_the_pooled_deviation_ignores_the_level_of_a_scene() -> None:
    # Squared deviations 0.02 and 0.02 about each scene's own mean, over 2 degrees of freedom.
    assert pooled_deviation([np.array([1.0, 1.2]), np.array([5.0, 5.2])]) == pytest.approx(0.02**0.5)


def test_holm_is_step_down_and_monotone() -> None:
    # Textbook case: 0.01 x 4, 0.02 x 3, 0.03 x 2, 0.04 x 1, with the running maximum.
    assert holm([0.04, 0.01, None, 0.03, 0.02]) == [
        pytest.approx(x) if x else None for x in (0.06, 0.04, None, 0.06, 0.06)
    ]
    assert holm([0.9, 0.8]) == [1.0, 1.0]


def test_the_interval_of_scenes_is_close_to_students_where_views_do_not_vary() -> None:
    means = np.random.default_rng(3).normal(0.5, 1.0, 12)
    matrices = [np.full((2, 3), value) for value in means]
    interval = bootstrap_interval(matrices, True, 20_000, np.random.default_rng(0))
    expected = scipy.stats.t.interval(0.95, 11, means.mean(), scipy.stats.sem(means))
    assert (interval.low, interval.high) == pytest.approx(expected, abs=0.08)


# --- which question is answered


@pytest.mark.parametrize(
    ("scenes", "trials", "scope", "test"),
    [
        (1, 3, THIS_SCENE, "Student's t over 3 pairs"),
        (1, 6, THIS_SCENE, "exact sign flips of 6 pairs"),
        (2, 3, THESE_SCENES, "exact sign flips of 6 pairs"),
        (6, 1, SCENES_LIKE_THESE, "exact sign flips of 6 scenes"),
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
    rng = np.random.default_rng(42)
    wrong = covered = 0
    for _ in range(SIMULATIONS):
        result = compare(simulate(rng, scenes, trials, 8, scene_noise=scene_noise), 1, samples=300)
        wrong += result.verdict != "no evidence"
        covered += result.interval.low <= 0 <= result.interval.high
    assert wrong / SIMULATIONS < LIMIT
    assert covered / SIMULATIONS > 1 - LIMIT


def test_holm_holds_the_rate_of_any_false_scene() -> None:
    rng = np.random.default_rng(7)
    results = [compare(simulate(rng, 5, 3, 8, view_noise=0.0), 1, samples=50) for _ in range(SIMULATIONS)]
    assert np.mean([any(scene.p_holm < 0.05 for scene in result.scenes) for result in results]) < LIMIT
    assert np.mean([any(scene.p < 0.05 for scene in result.scenes) for result in results]) > 0.12  # without it, 23 %


def test_a_known_effect_is_found() -> None:
    rng = np.random.default_rng(5)
    found = [compare(simulate(rng, 2, 3, 8, effect=0.4, view_noise=0.05), 1, samples=300).verdict for _ in range(200)]
    assert found.count("better") > 180
    assert "worse" not in found


def test_seeds_needed_give_the_promised_power() -> None:
    seeds = seeds_needed(deviation=0.1, scenes=2, difference=0.1)
    rng = np.random.default_rng(0)

    def power(count: int) -> float:
        samples = rng.normal(0.1, 0.1, (3000, 2, count))
        return float(np.mean([stratified_t_p(list(sample)) < 0.05 for sample in samples]))

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
