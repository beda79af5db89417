"""Statistics and planning against SciPy, textbooks, cases counted by hand, and simulations."""

import numpy as np
import pytest
import scipy.stats

from gsbench.analysis.planning import (
    Components,
    Design,
    designs_like_these,
    estimate_components,
    power_like_these,
    seeds_needed,
    sweep_designs,
    sweep_power,
)
from gsbench.analysis.statistics import (
    ALPHA,
    Interval,
    judge_like_these,
    median_interval,
    outcome_of,
    t_test,
)
from tests.analysis.tables import TABLES
from tests.conftest import script
from tests.helpers import refusal

habits = script("habits")  # all draws at once; test_promises.py compares them with one


def test_the_test_of_one_scene_is_the_paired_t_test():
    values = np.array([0.3, 0.1, 0.25, 0.4])
    found, expected = t_test(values[None]), scipy.stats.ttest_1samp(values, 0)
    assert found.p == pytest.approx(expected.pvalue, rel=1e-9)
    for level in (0.95, 0.998):
        interval = found.interval(1 - level)
        assert (interval.low, interval.high) == pytest.approx(expected.confidence_interval(level))
    assert t_test(np.array([[0.3]])) is None


def test_scenes_have_equal_weights_and_their_own_variances():
    """By hand: variances 1 and 2 of three pairs each, and 1 and 9."""
    rows = np.array([[1.0, 2.0, 3.0], [3 - 2**0.5, 3.0, 3 + 2**0.5]])
    found = t_test(rows)
    assert found.mean == pytest.approx(2.5)
    assert found.error == pytest.approx((1 / 3 + 2 / 3) ** 0.5 / 2)
    assert found.region.even == pytest.approx(np.log2(3 / 2))
    one_noisy = t_test(np.array([[1.0, 2.0, 3.0], [1.0, 1.0, 1.0]]))
    assert one_noisy.p == pytest.approx(2 * scipy.stats.t.sf(1.5 / (1 / 12) ** 0.5, 2))


def test_two_pairs_suffice_and_single_ones_have_the_spread_of_scenes_for_that_of_trainings():
    for rows in ([[0.1, 0.3]], [[0.1], [0.3]], [[0.3], [0.1], [0.5]]):
        values = np.array(rows)
        found = t_test(values)
        assert found.p == pytest.approx(scipy.stats.ttest_1samp(values.ravel(), 0).pvalue)


@pytest.mark.parametrize(
    "low, high, known", [(0, 1, False), (-1, 0, False), (-1, 1, False), (0.1, 1, True)]
)
def test_an_interval_that_ends_at_zero_does_not_exclude_it(low, high, known):
    assert Interval(low, high).excludes_zero() == Interval(-high, -low).excludes_zero() == known


def test_without_spread_p_is_zero_or_for_no_difference_one():
    same = t_test(np.full((2, 3), 0.2))
    assert (same.p, same.interval()) == (0.0, Interval(same.mean, same.mean))
    nothing = t_test(np.zeros((2, 3)))
    assert nothing.p == 1.0


@pytest.mark.parametrize(
    "interval, sign, expected",
    TABLES["outcomes of intervals"],
)
def test_the_interval_alone_decides_the_outcome(interval, sign, expected):
    assert outcome_of(Interval(*interval), sign, 0.5) == expected


@pytest.mark.parametrize("seed", range(10))
def test_an_interval_excludes_zero_exactly_if_p_is_below_its_level(seed):
    rng = np.random.default_rng(seed)
    for level in (0.05, 0.0167, 0.005, 0.0033):
        scenes, seeds = (int(n) for n in rng.integers((1, 2), (9, 5)))
        found = t_test(rng.normal(rng.normal(0, 0.2), 0.1, (scenes, seeds)))
        assert (found.p < level) == found.interval(level).excludes_zero()


def test_below_the_tabulated_levels_student_decides():
    rows = np.array([[1.0, 1.2, 1.1], [2.0, 2.2, 2.1]])
    found = t_test(rows)
    half = scipy.stats.t.isf(0.0049 / 2, 2) * found.error
    interval = found.interval(0.0049)
    assert interval.high - found.mean == pytest.approx(half)
    assert found.interval(0.005).high - found.mean < half


# --- scenes like these


def test_scenes_like_these_are_judged_by_the_sign_test():
    means = np.array([-0.044, 0.001, 0.002, 0.003, 0.004, 0.005, 0.006, 0.007])
    found = judge_like_these(means, 1, 0.005)
    assert (found.helped, found.scenes, found.beyond) == (7, 8, 3)
    assert found.outcome == "undecided"
    assert found.needed == 8
    assert judge_like_these(np.abs(means), 1, 0.001).outcome == "supported"
    lower, either = (judge_like_these(means, sign, 0.005) for sign in (-1, 0))
    assert (lower.helped, lower.beyond) == (1, 1)
    assert (either.helped, either.beyond) == (7, 3)
    assert judge_like_these(means[:5], 1, 0.005) is None
    nothing = judge_like_these(np.zeros(6), 1, 0.0)
    assert (nothing.helped, nothing.beyond) == (0, 6)
    none = judge_like_these(-np.ones(6), 1, None)
    assert (none.helped, none.beyond, none.outcome) == (0, None, "refuted")


def test_the_interval_of_the_median_is_exact():
    """The ends of eight values miss the median with probability 2 / 2^8; six reach 5 %, not 1 %."""
    values = np.arange(8.0)
    assert median_interval(values, 0.05) == Interval(0.0, 7.0)
    assert median_interval(values, 0.3) == Interval(2.0, 5.0)  # 2 P(at most 2 of 8) = 0.289
    assert median_interval(values[:6], 0.05) == Interval(0.0, 5.0)
    # ranks of the exact 95 % interval in tables of the sign test, such as Conover's
    for count, low, high in ((9, 2, 8), (12, 3, 10), (20, 6, 15), (40, 14, 27)):
        ranks = np.arange(1.0, count + 1)
        assert median_interval(ranks, 0.05) == Interval(low, high)
    assert median_interval(values[:6], 0.01) is None


def test_the_statement_agrees_with_the_sign_test_at_every_level():
    rng = np.random.default_rng(1)
    for _ in range(50):
        means, level = rng.normal(0.5, 1, int(rng.integers(6, 14))), rng.choice([0.05, 0.0125])
        found = judge_like_these(means, 1, None, float(level))
        p = scipy.stats.binomtest(found.helped, len(means)).pvalue
        assert (found.outcome != "undecided") == (p <= level)


# --- false outcomes of simulated checks; scripts/untruths.py has the large table


def test_seeds_needed_give_the_promised_power():
    seeds = seeds_needed(deviation=0.1, scenes=2, difference=0.1)
    rng = np.random.default_rng(0)

    def power(count):
        found = habits.p_values(rng.normal(0.1, 0.1, (2000, 2, count)))[1]
        return (found < ALPHA).mean()

    assert 0.76 < power(seeds) < 0.93
    assert power(seeds - 1) < 0.82
    assert seeds_needed(0.0, 1, 0.1) == 2
    assert seeds_needed(100.0, 1, 0.001) is None
    needed = [seeds_needed(deviation, 1, 1.0) for deviation in np.linspace(1.5, 3, 200)]
    assert max(count for count in needed if count is not None) == 40
    assert needed[-1] is None


KNOWN = Components(between=0.3, within=0.5, scenes=4, trials=12)


def test_components_are_unbiased_also_with_unequal_seeds():
    rng = np.random.default_rng(0)
    within, between = [], []
    for _ in range(4000):
        pilot = [rng.normal(0, 0.3) + rng.normal(0, 0.5, count) for count in (2, 3, 5, 3, 4, 2)]
        found = estimate_components(pilot)
        within.append(found.within**2)
        between.append(found.between**2)
    assert np.mean(within) == pytest.approx(0.25, rel=0.03)
    assert np.mean(between) == pytest.approx(0.09, abs=0.03)  # cut off at zero, so a little above


def test_components_of_equal_scenes_by_hand():
    # Means 1 and 4, variance 2 within each: 4.5 between means, of which 2 / 2 is noise.
    found = estimate_components([np.array([0.0, 2.0]), np.array([3.0, 5.0])])
    assert found.within == pytest.approx(2**0.5)
    assert found.between == pytest.approx(3.5**0.5)
    assert (found.scenes, found.trials) == (2, 4)


def test_equal_scenes_have_no_variance_between_them():
    assert estimate_components([np.array([0.0, 2.0]), np.array([0.0, 2.0])]).between == 0.0
    assert estimate_components([np.array([0.0, 2.0])]).between is None
    with refusal("two seeds"):
        estimate_components([np.array([1.0]), np.array([2.0])])


@pytest.mark.parametrize("like_asked", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_power_is_the_share_of_simulated_sweeps_that_see_the_difference(like_asked):
    rng = np.random.default_rng(1)
    design, effect, sweeps = Design(8, 3), 0.35, 4000
    scenes = rng.normal(0, KNOWN.between or 0.0, (sweeps, design.scenes, 1)) if like_asked else 0.0
    values = effect + scenes + rng.normal(0, KNOWN.within, (sweeps, design.scenes, design.seeds))
    if like_asked:
        agree = (values.mean(axis=2) > 0).sum(axis=1)
        seen = [scipy.stats.binomtest(int(count), design.scenes).pvalue <= 0.05 for count in agree]
    else:
        seen = habits.p_values(values)[1] < 0.05
    power = power_like_these if like_asked else sweep_power
    assert power(design, effect, KNOWN) == pytest.approx(np.mean(seen), abs=0.03)


def test_seeds_do_not_replace_scenes():
    """If scenes differ by more than the effect, no number of seeds shows scenes like these."""
    scattered = Components(between=5.0, within=0.1, scenes=4, trials=12)
    assert designs_like_these(0.5, scattered) == []
    assert sweep_designs(0.5, scattered)[0] == Design(1, 3)
    assert Design(1, 3).trials == 6  # of two arms


def test_a_plan_for_scenes_like_these_needs_two_scenes():
    one_scene = estimate_components([np.array([0.0, 2.0])])
    with refusal("two"):
        power_like_these(Design(6, 2), 1.0, one_scene)
