"""The thresholds of means over scenes: Student's at the ends, and no false sign too many."""

import numpy as np
import pytest
import scipy.stats

from gsbench.analysis.statistics import Region, evenness, table

DRAWS = 20_000
CASES = [(2, 3), (3, 2), (3, 3), (4, 4), (8, 3), (7, 7), (13, 2), (30, 2), (25, 5), (45, 3)]


def false_signs(noise, seeds, level, effect=0.0):
    """The share of sweeps without an effect, or with one in standard errors, that show a sign."""
    rng = np.random.default_rng([len(noise), seeds, round(10 * noise[0])])
    variances = noise**2 * rng.chisquare(seeds - 1, (DRAWS, len(noise))) / (seeds - 1)
    true, found = np.sqrt((noise**2).sum()), np.sqrt(variances.sum(axis=1))
    limits = Region(len(noise), seeds, evenness(variances)).limits(level)
    # the mean over scenes is normal and does not depend on the variances
    half = limits * found / true
    return float((scipy.stats.norm.sf(half - effect) + scipy.stats.norm.cdf(-half - effect)).mean())


@pytest.mark.parametrize("scenes, seeds", CASES)
@pytest.mark.parametrize("ratio", [1.0, 10.0, 20.0, 100.0])
def test_false_signs_keep_their_level(scenes, seeds, ratio):
    noise = np.where(np.arange(scenes) < 1, ratio, 1.0)
    for level in (0.05, 0.0125):
        assert false_signs(noise, seeds, level) < 1.04 * level + 2 * (level / DRAWS) ** 0.5


def test_power_at_three_standard_errors_is_more_than_half():
    assert false_signs(np.ones(3), 3, 0.05, 3.0) > 0.54


def test_one_scene_with_all_variance_has_the_t_test():
    for scenes, seeds in CASES:
        even = evenness(np.array([[2.0] + [0.0] * (scenes - 1)]))
        for level in (0.3, 0.05, 0.01, 1e-5):
            found = Region(scenes, seeds, even).limits(level)
            assert found == pytest.approx(scipy.stats.t.isf(level / 2, seeds - 1))
    assert evenness(np.zeros((1, 3))) == 0.0
    assert evenness(np.full((1, 5), 0.3)) == pytest.approx(1.0)


@pytest.mark.parametrize("seeds", [2, 3, 4, 5, 7, 8, 12])
@pytest.mark.parametrize("scenes", [2, 3, 7, 13, 30, 50])
def test_a_smaller_level_needs_a_larger_difference(scenes, seeds):
    found = Region(scenes, seeds, np.linspace(0, 1, 41))
    limits = np.array([found.limits(level) for level in np.geomspace(1e-8, 0.98, 200)])
    assert (np.diff(limits, axis=0) < 0).all()
    assert (np.diff(limits, axis=1) < 1e-9).all()  # the more evenly, the lower


def test_p_is_the_level_whose_threshold_is_the_size():
    found = Region(3, 4, np.linspace(0, 1, 7))
    for level in (0.6, 0.05, 0.004, 1e-5):
        assert found.p_values(found.limits(level)) == pytest.approx(level, rel=1e-8)


def test_the_table_is_complete():
    own = table()
    assert own["f"].shape == tuple(len(own[one]) for one in ("scenes", "seeds", "levels", "knots"))
    assert own["f"].min() >= 0
    assert own["f"].max() <= 1
    assert not own["f"][..., 0].any()
