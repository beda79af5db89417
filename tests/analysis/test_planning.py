"""Variance components and power, against a textbook's estimator restated, and simulation with scipy's tests."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import scipy.stats

from gsbench.analysis.planning import (
    Components,
    Design,
    designs_needed,
    estimate_components,
    power,
)
from gsbench.analysis.statistics import t_test
from gsbench.errors import InputError

KNOWN = Components(between=0.3, within=0.5, scenes=4, trials=12)


def test_components_are_unbiased_also_with_unequal_seeds() -> None:
    rng = np.random.default_rng(0)
    within, between = [], []
    for _ in range(4000):
        pilot = [rng.normal(0, 0.3) + rng.normal(0, 0.5, count) for count in (2, 3, 5, 3, 4, 2)]
        found = estimate_components(pilot)
        within.append(found.within**2)
        between.append(found.between**2)
    assert np.mean(within) == pytest.approx(0.25, rel=0.03)
    assert np.mean(between) == pytest.approx(0.09, abs=0.03)  # cut off at zero, so a little above


def test_components_of_equal_scenes_by_hand() -> None:
    # Means 1 and 4, variance 2 within each: 4.5 between means, of which 2 / 2 is noise.
    found = estimate_components([np.array([0.0, 2.0]), np.array([3.0, 5.0])])
    assert found.within == pytest.approx(2**0.5)
    assert found.between == pytest.approx(3.5**0.5)
    assert (found.scenes, found.trials) == (2, 4)


def test_scenes_that_do_not_differ_have_no_variance_of_their_own() -> None:
    assert estimate_components([np.array([0.0, 2.0]), np.array([0.0, 2.0])]).between == 0.0
    assert estimate_components([np.array([0.0, 2.0])]).between is None
    with pytest.raises(InputError, match="two seeds"):
        estimate_components([np.array([1.0]), np.array([2.0])])


@pytest.mark.parametrize("like_asked", [False, True])
def test_power_is_the_share_of_simulated_sweeps_that_see_it(like_asked: bool) -> None:
    rng = np.random.default_rng(1)
    design, effect, sweeps = Design(8, 3), 0.35, 4000
    scenes = rng.normal(0, KNOWN.between or 0.0, (sweeps, design.scenes, 1)) if like_asked else 0.0
    values = effect + scenes + rng.normal(0, KNOWN.within, (sweeps, design.scenes, design.seeds))
    if like_asked:
        agree = (values.mean(axis=2) > 0).sum(axis=1)
        seen = [scipy.stats.binomtest(int(count), design.scenes).pvalue <= 0.05 for count in agree]
    else:
        seen = [(test := t_test(one)) is not None and test.p < 0.05 for one in values]
    assert power(design, effect, KNOWN, like_asked) == pytest.approx(np.mean(seen), abs=0.03)


@pytest.mark.parametrize("like_these", [False, True])
def test_designs_that_are_needed_just_suffice(like_these: bool) -> None:
    designs = designs_needed(0.35, KNOWN, like_these)
    assert designs
    for one in designs:
        assert power(one, 0.35, KNOWN, like_these) >= 0.8
        if one.seeds > 2:
            assert power(Design(one.scenes, one.seeds - 1), 0.35, KNOWN, like_these) < 0.8
    assert all(b.scenes > a.scenes and b.seeds < a.seeds for a, b in itertools.pairwise(designs))
    assert min(one.scenes for one in designs) >= (6 if like_these else 1)


def test_seeds_do_not_replace_scenes() -> None:
    """Where scenes differ by more than the effect, no number of seeds speaks of scenes like these."""
    scattered = Components(between=5.0, within=0.1, scenes=4, trials=12)
    assert designs_needed(0.5, scattered, like_these=True) == []
    assert designs_needed(0.5, scattered, like_these=False)[0] == Design(1, 3)


def test_questions_without_an_answer_are_refused() -> None:
    one_scene = estimate_components([np.array([0.0, 2.0])])
    with pytest.raises(InputError, match="two"):
        designs_needed(1.0, one_scene, like_these=True)
    for difference in (0.0, float("nan"), float("inf")):
        with pytest.raises(InputError, match="other than 0"):
            designs_needed(difference, KNOWN, like_these=False)
