"""Plans against simulated sweeps that the judge's test decides."""

import numpy as np
import pytest

from gsbench.analysis.planning import (
    POWER,
    Components,
    Design,
    Purpose,
    deviation_range,
    estimate_components,
    power_of_mean,
)
from gsbench.analysis.questions import look_shares, plan_looks
from gsbench.analysis.statistics import t_test

EVEN = Components(0.0, 0.1, 3, 9)


def deviations(*ratios):
    """Deviations of scenes in these ratios, with a root mean square of 1."""
    return np.array(ratios) / np.sqrt(np.mean(np.square(ratios)))


def shown(rng, noise, seeds, difference, looks=(), level=0.05):
    """Return whether the test shows the difference of scenes that have this noise."""
    pairs = difference + np.asarray(noise)[:, None] * rng.standard_normal((len(noise), seeds))
    looks = looks or (seeds,)
    return any(
        t_test(pairs[:, :look]).interval(share * level).excludes_zero()
        for look, share in zip(looks, look_shares(len(looks)), strict=True)
    )


@pytest.mark.parametrize("purpose", [Purpose(), Purpose(looks=True), Purpose(0.0125, looks=True)])
def test_designs_have_the_fewest_seeds_that_suffice(purpose):
    designs = purpose.designs(0.2, EVEN)
    assert designs
    for one in designs:
        assert purpose.power(one, 0.2, EVEN) >= POWER
        fewer = Design(one.scenes, one.seeds - 1)
        assert one.seeds == 2 or purpose.power(fewer, 0.2, EVEN) < POWER


def test_the_power_of_looks_is_that_of_the_judge():
    design, rng = Design(3, 4), np.random.default_rng(0)
    noise = [0.1] * 3
    found = [shown(rng, noise, 4, 0.2, plan_looks(4), 0.05 / 4) for _ in range(2000)]
    planned = Purpose(0.05 / 4, looks=True).power(design, 0.2, EVEN)
    assert np.mean(found) == pytest.approx(planned, abs=0.03)
    assert planned < Purpose().power(design, 0.2, EVEN)


@pytest.mark.parametrize("ratios", [(1, 1, 1), (4, 1, 1), (2, 1, 1), (1, 4, 4)])
def test_a_plan_holds_where_one_scene_is_noisier_than_the_others(ratios):
    rng, noise = np.random.default_rng(0), deviations(*ratios)
    pilot = estimate_components([one * rng.standard_normal(400) for one in noise])
    designs = {design.scenes: design for design in Purpose().designs(1.0, pilot)}
    three = designs[3]
    found = np.mean([shown(rng, noise, three.seeds, 1.0) for _ in range(3000)])
    assert found == pytest.approx(Purpose().power(three, 1.0, pilot), abs=0.03)
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


def test_giving_up_costs_power():
    plain, ledger = Purpose(0.005, looks=True), Purpose(0.005, looks=True, give_up=0.05)
    for design in (Design(1, 8), Design(3, 5)):
        assert ledger.power(design, 0.15, EVEN) < plain.power(design, 0.15, EVEN)
    assert plain.power(Design(1, 2), 0.1, Components(None, 0.0, 1, 2)) == 1.0


def test_the_range_of_the_deviation_holds_the_real_one_in_80_percent_of_pilots():
    rng = np.random.default_rng(0)
    ranges = [
        deviation_range(estimate_components(list(rng.normal(0, 1, (3, 3))))) for _ in range(3000)
    ]
    assert np.mean([low <= 1 <= high for low, high in ranges]) == pytest.approx(0.8, abs=0.03)
    assert deviation_range(Components(None, 1.0, 1, 41))[0] > 0.85
