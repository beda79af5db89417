"""The formulas of the volume rule on cases computed by hand, and its thresholds and budgets."""

import math

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from gsbench.densify import ADC, DensifyContext, Lineage, Volumetric
from gsbench.densify.budget import admit
from gsbench.densify.volumetric import log_condition, log_volume
from tests.densify.helpers import at, generator, trained
from tests.gaussians.helpers import random_gaussians
from tests.helpers import table


def scales(*rows):
    return torch.tensor(rows, dtype=torch.float64).log()


def test_children_of_an_elongated_gaussian_match_a_calculation_by_hand():
    """A Gaussian with axes 2, 1, 1 has kappa = 4.

    Its eigenvalues 4, 1, 1 become 1, 1/4, 1/4, so its axes become 1, 1/2, 1/2. The volume is
    divided by 8 = 4^1.5.
    """
    parent = scales((2.0, 1.0, 1.0))
    assert math.exp(log_condition(parent)) == pytest.approx(4)
    child = Volumetric().child_log_scales(parent)
    assert_close(child.exp(), torch.tensor([[1.0, 0.5, 0.5]], dtype=torch.float64))
    assert math.exp(log_volume(parent) - log_volume(child)) == pytest.approx(8)
    as_adc = Volumetric(condition_of="nothing").child_log_scales(parent)  # no eq. 7
    assert_close(as_adc.exp(), parent.exp() / 1.6)
    in_scales = Volumetric(condition_of="scales").child_log_scales(parent)  # s / kappa
    assert_close(in_scales.exp(), torch.tensor([[0.5, 0.25, 0.25]], dtype=torch.float64))


def test_children_of_a_needle_vanish_unless_kappa_is_limited():
    needle = scales((1.0, 1e-3, 1e-3))  # kappa = 1e6
    assert_close(
        Volumetric().child_log_scales(needle).exp(),
        torch.tensor([[1e-3, 1e-6, 1e-6]], dtype=torch.float64),
    )
    limited = Volumetric(max_condition=4.0).child_log_scales(needle)
    assert_close(limited.exp(), torch.tensor([[0.5, 5e-4, 5e-4]], dtype=torch.float64))


def test_volume_does_not_underflow():
    tiny = torch.full((1, 3), -300.0)
    assert float(log_volume(tiny)) == pytest.approx(-900 + math.log(4 * math.pi / 3))


def run_volume_rule(log_scales, rounds=1, **options):
    gaussians = random_gaussians(len(log_scales))
    gaussians.log_scales = log_scales.clone()
    gaussians.opacity_logits.fill_(2.0)
    densifier = Volumetric(**options)
    densifier.begin(gaussians, DensifyContext(extent=10.0))
    trainable = trained(gaussians, 10.0)
    rng = generator(0)
    return [densifier.refine(600 + 100 * i, trainable, rng) for i in range(rounds)]


def test_only_a_volume_above_the_threshold_is_split():
    at = scales((0.2, 0.2, 0.2))
    for factor, split in ((1 + 1e-12, 0), (1 - 1e-12, 1)):
        threshold = math.exp(log_volume(at)) * factor
        assert run_volume_rule(at, volume_threshold=threshold)[0].split_volume == split


def test_isotropic_gaussians_are_split_in_every_round():
    sphere = scales((0.5, 0.5, 0.5))
    events = run_volume_rule(sphere, rounds=5)
    assert [event.isotropic_resplit for event in events] == [1, 2, 4, 8, 16]
    assert [event.after for event in events] == [2, 4, 8, 16, 32]
    assert run_volume_rule(sphere, rounds=5, split_isotropic=False)[-1].after == 1
    hard, soft = (
        run_volume_rule(sphere, rounds=8, max_gaussians=11, cap=cap)[-1] for cap in ("hard", "soft")
    )
    assert hard.after == hard.blocked_by_cap == 11
    assert soft.after == 16  # a round that starts with 8 exceeds the cap, the next does not grow


def test_vanishing_needles_are_reported():
    # children of the disc have axes of at most 1e-4
    shapes = scales((30.0, 30.0, 1e-4), (0.6, 0.5, 0.4))
    (event,) = run_volume_rule(shapes)
    assert (event.split_volume, event.vanished) == (2, 1)  # below 1e-4 of the extent of 10
    assert run_volume_rule(shapes, max_condition=100.0)[0].vanished == 0


def test_each_threshold_mode_selects_the_expected_number():
    log_scales = random_gaussians(1000, log_scale=(-4, 0)).log_scales
    volumes = log_volume(log_scales)

    def selected(mode, scales=log_scales, **options):
        return run_volume_rule(scales, threshold_mode=mode, **options)[0].split_volume

    above = (volumes.exp() > 0.03).sum()
    assert selected("absolute") == selected("extent_relative", volume_threshold=3e-5) == above
    assert selected("quantile", volume_quantile=0.99) == 10
    outlier = torch.cat([log_scales, torch.tensor([[2.0, 2.1, 2.2]]).expand(3, 3)])
    first, third = np.quantile(log_volume(outlier), (0.25, 0.75))
    expected = (log_volume(outlier) > third + 1.5 * (third - first)).sum()
    assert selected("auto", outlier) == expected >= 3


def test_the_auto_threshold_does_not_depend_on_the_scale_of_the_scene():
    log_scales = random_gaussians(500, log_scale=(-5, 0.5)).log_scales
    log_scales[:5] += 2.5
    counts = {
        run_volume_rule(log_scales + math.log(k), threshold_mode="auto")[0].split_volume
        for k in (0.01, 1, 50)
    }
    assert len(counts) == 1
    assert counts.pop() > 0


def test_admit_chooses_the_best_scores_and_counts_the_refused():
    candidates = torch.tensor([True, True, False, True])
    admitted, refused = admit(candidates, torch.tensor([1.0, 3.0, 9.0, 3.0]), 1, 2)
    assert admitted.tolist() == [False, True, False, True]
    assert refused == 1
    admitted, refused = admit(torch.ones(4).bool(), torch.arange(4.0), 2, 5)
    assert (admitted.tolist(), refused) == ([False, False, True, True], 2)


@pytest.mark.parametrize(
    "count, most, cap, allowed",
    table(__file__, "caps"),
)
def test_each_cap_allows_the_expected_number(count, most, cap, allowed):
    densifier = ADC(cap=cap)
    densifier.max_gaussians, densifier.lineage = most, Lineage(5)
    assert densifier.allowance(at(densifier.stop, range(count))) == allowed


def test_the_volume_rule_can_have_its_own_window():
    own = Volumetric(volume_start=1000, volume_stop=2000, volume_interval=200)
    assert [*filter(own.volume_due, range(100, 3000, 100))] == [*range(1200, 2000, 200)]
    as_adc = Volumetric(start=1000, stop=1400)
    assert [*filter(as_adc.volume_due, range(50, 3000, 50))] == [1100, 1200, 1300]


@pytest.mark.parametrize("mode", ["quantile", "auto"])
def test_the_threshold_of_an_empty_set_is_infinite(mode):
    assert Volumetric(threshold_mode=mode).log_threshold(torch.zeros(0)) == math.inf
