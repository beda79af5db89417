"""Ratios of counts at equal quality, against exact curves, another fit and simulations."""

from contextlib import suppress

import numpy as np
import pytest

from gsbench.analysis.report.curves import log_ratio, saving_words
from gsbench.analysis.statistics import t_test
from gsbench.errors import InputError
from tests.analysis.helpers import page_of
from tests.helpers import refusal
from tests.trials import ask_about, write_trial

COUNTS = np.array([10_000.0, 20_000, 40_000, 80_000])


def curve(counts, quality):
    return [(count, quality(count)) for count in counts]


def lpips_like(count):
    """A saturating curve like LPIPS over counts; less is better."""
    return 0.1 + 0.3 * (count / 10_000) ** -0.6


def test_an_arm_with_equal_quality_at_three_quarters_of_the_counts_saves_a_quarter():
    baseline = curve(COUNTS, lpips_like)
    arm = [(0.75 * count, value) for count, value in baseline]
    assert log_ratio(arm, baseline, -1) == pytest.approx(np.log(0.75))
    assert log_ratio(baseline, arm, -1) == pytest.approx(-np.log(0.75))


def test_the_ratio_is_exact_for_curves_that_are_straight_in_the_logarithm():
    """PCHIP keeps straight lines: quality log n against 2 + log n / 2, common range by hand."""
    baseline = curve(COUNTS, lambda n: np.log(n / 10_000))  # 0 to 2.08
    arm = curve(COUNTS, lambda n: 0.5 + 0.5 * np.log(n / 10_000))  # 0.5 to 1.54
    low, high = 0.5, 0.5 + 0.5 * np.log(8)
    # log counts over 10,000 at quality q: q and 2 q - 1
    assert log_ratio(arm, baseline, 1) == pytest.approx((low + high) / 2 - 1)


def test_the_ratio_is_near_that_of_cubic_polynomials_as_in_the_original_method():
    """Rates and PSNR of the example that comes with public implementations of VCEG-M33."""
    first = [686.76, 309.58, 157.11, 85.95], [40.28, 37.18, 34.24, 31.42]
    second = [893.34, 407.80, 204.93, 112.75], [40.39, 37.21, 34.17, 31.24]
    low, high = 31.42, 40.28
    integrals = []
    for rates, psnr in (second, first):
        whole = np.polyint(np.polyfit(psnr, np.log(rates), 3))
        integrals.append((np.polyval(whole, high) - np.polyval(whole, low)) / (high - low))
    found = log_ratio(*(list(zip(*one, strict=True)) for one in (second, first)), 1)
    assert found == pytest.approx(integrals[0] - integrals[1], abs=0.002)
    assert found > 0.2


@pytest.mark.parametrize(
    "quality, why",
    [
        (dict(zip(COUNTS, [1, 3, 2, 4], strict=True)).get, "always give the arm better quality"),
        (lambda n: np.log(n) + 1.2, "only 42% of the range"),  # of a range of 2.08, 0.88
        (
            lambda n: np.log(n) + 3,
            "the arm with 10,000 Gaussians is better than the baseline with 80",
        ),
        (lambda n: np.log(n) - 3, "the baseline with 10,000 Gaussians is better than the arm with"),
        (lambda n: np.nan, "always give the arm better quality"),
    ],
)
def test_curves_that_turn_or_share_little_are_not_comparable(quality, why):
    with refusal(why):
        log_ratio(curve(COUNTS, quality), curve(COUNTS, np.log), 1)


def test_the_interval_is_students_over_pairs_and_needs_two():
    # t of 2 degrees of freedom at 97.5 %: 4.302653
    assert saving_words(np.log([0.70, 0.75, 0.78])) == "26 % fewer Gaussians (−35 to −15 %)"
    assert saving_words([-0.1, 0.1]) == "0 % more Gaussians (−72 to +256 %)"
    assert saving_words([0.1]) == "11 % more Gaussians (one pair: no interval)"


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
    said = "garden: volumetric has the PSNR (dB) of adc with 25 % fewer Gaussians (−25 to −25 %)"
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
                curves.append(list(zip(counts, values, strict=True)))
            with suppress(InputError):
                ratios.append(log_ratio(*curves, -1))
        if len(ratios) == 3:
            total += 1
            found = t_test(np.array([ratios])).interval()
            covered += found.low <= np.log(true) <= found.high
    assert total > 1490
    assert 0.92 < covered / total < 0.965
