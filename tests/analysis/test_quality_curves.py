"""Ratios of counts at equal quality, against exact curves, another fit and simulations."""

import numpy as np
import pytest

from gsbench.analysis.curves import CountRatio, Curve, count_ratio, count_saving
from tests.analysis.helpers import page_of
from tests.helpers import refusal
from tests.trials import ask_about, write_trial

COUNTS = np.array([10_000.0, 20_000, 40_000, 80_000])


def curve(counts, quality):
    return Curve.of(counts, [quality(count) for count in counts], 1)


def lpips_like(count):
    """A saturating curve like LPIPS over counts; less is better."""
    return 0.1 + 0.3 * (count / 10_000) ** -0.6


def test_an_arm_with_equal_quality_at_three_quarters_of_the_counts_saves_a_quarter():
    values = [lpips_like(count) for count in COUNTS]
    baseline, arm = (Curve.of(scale * COUNTS, values, -1) for scale in (1.0, 0.75))
    assert count_ratio(arm, baseline).log_ratio == pytest.approx(np.log(0.75))
    assert count_ratio(baseline, arm).log_ratio == pytest.approx(-np.log(0.75))


def test_the_ratio_is_exact_for_curves_that_are_straight_in_the_logarithm():
    """PCHIP keeps straight lines: quality log n against 2 + log n / 2, common range by hand."""
    baseline = curve(COUNTS, lambda n: np.log(n / 10_000))  # 0 to 2.08
    arm = curve(COUNTS, lambda n: 0.5 + 0.5 * np.log(n / 10_000))  # 0.5 to 1.54
    low, high = 0.5, 0.5 + 0.5 * np.log(8)
    # log counts over 10,000 at quality q: q and 2 q - 1
    expected = (low + high) / 2 - 1
    assert count_ratio(arm, baseline).log_ratio == pytest.approx(expected)


def test_the_ratio_is_near_that_of_cubic_polynomials_as_in_the_original_method():
    """Rates and PSNR of the example that comes with public implementations of VCEG-M33."""
    first = [686.76, 309.58, 157.11, 85.95], [40.28, 37.18, 34.24, 31.42]
    second = [893.34, 407.80, 204.93, 112.75], [40.39, 37.21, 34.17, 31.24]
    low, high = 31.42, 40.28
    integrals = []
    for rates, psnr in (second, first):
        whole = np.polyint(np.polyfit(psnr, np.log(rates), 3))
        integrals.append((np.polyval(whole, high) - np.polyval(whole, low)) / (high - low))
    found = count_ratio(Curve.of(*second, 1), Curve.of(*first, 1)).log_ratio
    assert found == pytest.approx(integrals[0] - integrals[1], abs=0.002)
    assert found > 0.2


@pytest.mark.parametrize("swapped", [False, True])
def test_an_arm_better_at_its_fewest_than_the_other_at_its_most_gives_a_bound(swapped):
    baseline = curve(COUNTS, lambda n: np.log(n))
    ahead = curve(COUNTS, lambda n: np.log(n) + 3)
    pair = (baseline, ahead) if swapped else (ahead, baseline)
    found = count_ratio(*pair)
    assert found.log_ratio is None
    assert found.bound == pytest.approx(np.log(8) if swapped else -np.log(8))
    words = "at least 700 % more Gaussians" if swapped else "at least 88 % fewer Gaussians"
    assert count_saving([[found, found]]).words == words
    other = CountRatio(None, "x", -found.bound)
    assert count_saving([[found, other]]).words.startswith("not comparable: the ")


def test_curves_that_turn_or_share_little_are_not_comparable():
    straight = curve(COUNTS, lambda n: np.log(n))
    turning = Curve.of(COUNTS, [1.0, 3.0, 2.0, 4.0], 1)
    found = count_ratio(turning, straight)
    assert (found.log_ratio, found.bound) == (None, None)
    assert found.why_not == "more Gaussians do not always give the arm better quality"
    apart = curve(COUNTS, lambda n: np.log(n) + 1.2)  # of a range of 2.08, 0.88 are common
    found = count_ratio(apart, straight)
    assert found.why_not == "only 42 % of the range of quality is common".replace(" %", "%")
    assert count_saving([[found]]).change is None


def test_the_interval_is_students_over_pairs_and_needs_every_pair():
    logs = np.log([0.70, 0.75, 0.78])
    ratios = [[CountRatio(float(value)) for value in logs]]
    found = count_saving(ratios)
    half = 4.302653 * logs.std(ddof=1) / 3**0.5  # t of 2 degrees of freedom at 97.5 %
    assert found.change == pytest.approx(np.exp(logs.mean()) - 1)
    assert found.interval.low == pytest.approx(np.exp(logs.mean() - half) - 1, rel=1e-5)
    assert found.interval.high == pytest.approx(np.exp(logs.mean() + half) - 1, rel=1e-5)
    assert found.words == "26 % fewer Gaussians (15 to 35 %)"
    assert count_saving([[*ratios[0], CountRatio(None, "it turns")]]).words == (
        "not comparable: it turns"
    )
    assert count_saving([[CountRatio(0.1)]]).words == "11 % more Gaussians (one pair: no interval)"


def test_wrong_curves_are_refused():
    with refusal("needs 3 counts, got 2"):
        Curve.of([1, 2], [1, 2], 1)
    with refusal("positive counts and finite values"):
        Curve.of([0, 1, 2], [1, 2, 3], 1)
    with refusal("positive counts and finite values"):
        Curve.of([1, 2, 3], [1, 2, np.nan], 1)


def write_curves(tmp_path, limits):
    """adc at ``limits``, and volumetric with the same PSNR at three quarters of the counts."""
    for densify, scale in (("adc", 1.0), ("volumetric", 0.75)):
        for place, limit in enumerate(limits):
            for seed in (10, 11, 12):
                write_trial(
                    tmp_path,
                    seed,
                    f"{place}{limit:07d}",
                    {"densify.max_gaussians": limit, "densify.cap": "governor"},
                    densify=densify,
                    psnr=[25 + np.log(limit) + 0.01 * seed],
                    _num_gaussians=round(scale * limit),
                )
    ask_about(tmp_path)


def test_the_report_says_how_many_fewer_gaussians_reach_the_baselines_quality(tmp_path):
    write_curves(tmp_path, [20_000, 40_000, 60_000])
    page = page_of(tmp_path)
    said = "garden: volumetric has the PSNR (dB) of adc with 25 % fewer Gaussians (25 to 25 %)"
    assert page.count(f"{said}; an estimate, not tested.") == 1  # the words of the picture


def test_two_counts_make_no_curve(tmp_path):
    write_curves(tmp_path, [20_000, 40_000])
    assert "an estimate, not tested" not in page_of(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.001, 0.004])
@pytest.mark.parametrize("true", [1.0, 0.73])
def test_the_interval_covers_the_true_ratio_as_often_as_it_says(true, noise):
    """Three seeds; LPIPS with noise of each training, and counts that miss their budgets by 1 %.

    With little noise the error of the interpolation shows, a third of a percent of the counts here:
    92.9 % of the intervals cover in place of 95.
    """
    rng, covered, total = np.random.default_rng(0), 0, 0
    for _ in range(1500):
        ratios = []
        for _ in range(3):
            curves = []
            for scale in (true, 1.0):
                counts = COUNTS * np.exp(rng.normal(0, 0.01, 4))
                values = lpips_like(counts / scale) + rng.normal(0, noise, 4)
                curves.append(Curve.of(counts, values, -1))
            ratios.append(count_ratio(*curves))
        found = count_saving([ratios])
        total += found.change is not None
        if found.interval is not None:
            covered += found.interval.low <= true - 1 <= found.interval.high
    assert total > 1490
    assert 0.92 < covered / total < 0.965
