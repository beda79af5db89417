"""Plans against simulated sweeps that the judge's test decides."""

import itertools
from functools import partial

import numpy as np
import pytest

from gsbench.analysis.planning import (
    POWER,
    Components,
    Design,
    deviation_range,
    estimate_components,
    fewest_seeds,
    power_like_these,
    power_of_mean,
    sweep_designs,
    sweep_power,
)
from gsbench.analysis.statistics import t_test

EVEN = Components(0.0, 0.1, 3, 9)


def deviations(*ratios):
    """Deviations of scenes in these ratios, with a root mean square of 1."""
    return np.array(ratios) / np.sqrt(np.mean(np.square(ratios)))


def shown(rng, noise, seeds, difference):
    """Return whether the test shows the difference of scenes that have this noise."""
    pairs = difference + np.asarray(noise)[:, None] * rng.standard_normal((len(noise), seeds))
    return t_test(pairs).interval().excludes_zero()


LIKE = Components(0.3, 0.5, 4, 12)
like_these = partial(power_like_these, difference=0.35, components=LIKE)


@pytest.mark.parametrize(
    "designs, power",
    [
        (sweep_designs(0.2, EVEN, 0.05), lambda one: sweep_power(one, 0.2, EVEN, 0.05)),
        (sweep_designs(0.2, EVEN, 0.0125), lambda one: sweep_power(one, 0.2, EVEN, 0.0125)),
        (fewest_seeds(like_these, range(1, 31)), like_these),
    ],
    ids=["these scenes", "at a quarter of the level", "scenes like these"],
)
def test_designs_have_the_fewest_seeds_that_suffice(designs, power):
    assert designs
    for one in designs:
        assert power(one) >= POWER
        assert one.seeds == 2 or power(Design(one.scenes, one.seeds - 1)) < POWER
    ordered = sorted(designs, key=lambda one: one.scenes)
    assert all(b.seeds < a.seeds for a, b in itertools.pairwise(ordered))
    assert power is not like_these or ordered[0].scenes >= 6


@pytest.mark.parametrize(
    "ratios",
    [
        (4, 1, 1),
        *(pytest.param(r, marks=pytest.mark.slow) for r in ((1, 1, 1), (2, 1, 1), (1, 4, 4))),
    ],
)
def test_a_plan_holds_where_one_scene_is_noisier_than_the_others(ratios):
    rng, noise = np.random.default_rng(0), deviations(*ratios)
    pilot = estimate_components([one * rng.standard_normal(400) for one in noise])
    designs = {design.scenes: design for design in sweep_designs(1.0, pilot)}
    three = designs[3]
    found = np.mean([shown(rng, noise, three.seeds, 1.0) for _ in range(3000)])
    assert found == pytest.approx(sweep_power(three, 1.0, pilot), abs=0.03)
    assert found > POWER - 0.02
    # Equal noise would promise too much.
    if ratios == (4, 1, 1):
        even = Design(3, min(s for s in range(2, 9) if power_of_mean(1, Design(3, s), 1.0) >= 0.8))
        assert np.mean([shown(rng, noise, even.seeds, 1.0) for _ in range(3000)]) < 0.75


def test_more_scenes_have_the_shares_of_the_pilots_scenes():
    pilot = Components(0.0, 1.0, 3, 9, (2.0, 0.5, 0.5))
    assert pilot.shares_of(3) == pytest.approx((0.5, 0.5, 2.0))
    assert pilot.shares_of(6) == pytest.approx((0.5, 0.5, 0.5, 0.5, 2.0, 2.0))
    assert pilot.shares_of(1) == (1.0,)


def test_the_range_of_the_deviation_holds_the_real_one_in_80_percent_of_pilots():
    rng = np.random.default_rng(0)
    ranges = [
        deviation_range(estimate_components(list(rng.normal(0, 1, (3, 3))))) for _ in range(3000)
    ]
    assert np.mean([low <= 1 <= high for low, high in ranges]) == pytest.approx(0.8, abs=0.03)
    assert deviation_range(Components(None, 1.0, 1, 41))[0] > 0.85
