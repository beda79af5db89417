"""Plans against simulated sweeps that the judge decides."""

import numpy as np
import pytest

from gsbench.analysis.designs import POWER, Components, Design, estimate_components
from gsbench.analysis.planning import Purpose, deviation_range
from tests.conftest import script

promises = script("promises")


@pytest.mark.parametrize("purpose", [Purpose(), Purpose(looks=True), Purpose(0.0125, looks=True)])
def test_designs_have_the_fewest_seeds_that_suffice(purpose):
    designs = purpose.designs(0.2, 0.1)
    assert designs
    for one in designs:
        assert purpose.power(one, 0.2, 0.1) >= POWER
        fewer = Design(one.scenes, one.seeds - 1)
        assert one.seeds == 2 or purpose.power(fewer, 0.2, 0.1) < POWER


def test_the_power_of_a_check_is_that_of_its_verdicts():
    design, rng = Design(3, 4), np.random.default_rng(0)
    found = [promises.check(3, 4, 1.0, 0.2, 4)(rng) for _ in range(150)]
    planned = Purpose(0.05 / 4, looks=True).power(design, 0.2, 0.1)
    assert np.mean(found) == pytest.approx(planned, abs=0.1)
    assert planned < Purpose().power(design, 0.2, 0.1)


def test_giving_up_costs_power():
    plain, ledger = Purpose(0.005, looks=True), Purpose(0.005, looks=True, give_up=0.05)
    for design in (Design(1, 8), Design(3, 5)):
        assert ledger.power(design, 0.15, 0.1) < plain.power(design, 0.15, 0.1)
    assert plain.power(Design(1, 2), 0.1, 0.0) == 1.0


def test_the_range_of_the_deviation_holds_the_real_one_in_80_percent_of_pilots():
    rng = np.random.default_rng(0)
    ranges = [
        deviation_range(estimate_components(list(rng.normal(0, 1, (3, 3))))) for _ in range(3000)
    ]
    assert np.mean([low <= 1 <= high for low, high in ranges]) == pytest.approx(0.8, abs=0.03)
    assert deviation_range(Components(None, 1.0, 1, 41))[0] > 0.85
