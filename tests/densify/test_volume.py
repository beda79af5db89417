"""The formulas of the volume rule on cases computed by hand, and its thresholds and budgets."""

import math

import pytest
import torch
from torch.testing import assert_close

from gsbench.densify import DensifyContext, Volumetric
from gsbench.densify.budget import admit, allowance
from gsbench.densify.volumetric import log_condition, log_volume
from tests.densify.helpers import generator, trained
from tests.gaussians.helpers import random_gaussians


def scales(*rows):
    return torch.tensor(rows, dtype=torch.float64).log()


def test_children_of_an_isotropic_gaussian_have_its_size():
    sphere = scales((0.2, 0.2, 0.2))
    assert math.exp(log_volume(sphere)) == pytest.approx(4 / 3 * math.pi * 0.008)
    assert math.exp(log_condition(sphere)) == pytest.approx(1)
    assert_close(Volumetric().child_log_scales(sphere), sphere)


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
    events = [densifier.refine(600 + 100 * i, trainable, rng) for i in range(rounds)]
    return trainable, events, densifier


def radius_of(volume):
    return (volume * 3 / (4 * math.pi)) ** (1 / 3)


def test_only_a_volume_above_the_threshold_is_split():
    radius = radius_of(0.03)
    at = torch.full((1, 3), math.log(radius), dtype=torch.float64)
    exact = math.exp(float(log_volume(at)[0]))
    _, (event,), _ = run_volume_rule(at, volume_threshold=exact * (1 + 1e-12))
    assert event.split_volume == 0
    _, (event,), _ = run_volume_rule(at, volume_threshold=exact * (1 - 1e-12))
    assert event.split_volume == 1


def test_isotropic_gaussians_are_split_in_every_round():
    trainable, events, _ = run_volume_rule(scales((0.5, 0.5, 0.5)), rounds=5)
    assert [event.isotropic_resplit for event in events] == [1, 2, 4, 8, 16]
    assert len(trainable) == 32
    trainable, events, _ = run_volume_rule(scales((0.5, 0.5, 0.5)), rounds=5, split_isotropic=False)
    assert len(trainable) == 1
    trainable, events, _ = run_volume_rule(
        scales((0.5, 0.5, 0.5)), rounds=8, max_gaussians=11, cap="hard"
    )
    assert len(trainable) == 11
    assert events[-1].blocked_by_cap == 11
    trainable, events, _ = run_volume_rule(
        scales((0.5, 0.5, 0.5)), rounds=8, max_gaussians=11, cap="soft"
    )
    assert (
        len(trainable) == 16
    )  # a round that starts with 8 exceeds the cap, the next does not grow


def test_vanishing_needles_are_reported():
    # children of the disc have axes of at most 1e-4
    shapes = scales((30.0, 30.0, 1e-4), (0.6, 0.5, 0.4))
    _, (event,), _ = run_volume_rule(shapes)
    assert event.split_volume == 2
    assert event.vanished == 1  # below 1e-4 of the extent of 10
    _, (event,), _ = run_volume_rule(shapes, max_condition=100.0)
    assert event.vanished == 0


def test_each_threshold_mode_selects_the_expected_number():
    log_scales = random_gaussians(1000, log_scale=(-4, 0)).log_scales
    volumes = log_volume(log_scales)

    def selected(**options):
        return run_volume_rule(log_scales, **options)[1][0].split_volume

    assert selected(threshold_mode="absolute") == int((volumes.exp() > 0.03).sum())
    assert selected(threshold_mode="extent_relative", volume_threshold=3e-5) == int(
        (volumes.exp() > 0.03).sum()
    )
    assert selected(threshold_mode="quantile", volume_quantile=0.99) == 10
    outlier = torch.cat(
        [log_scales, torch.full((3, 3), 2.0, dtype=torch.float64) + torch.tensor([0.0, 0.1, 0.2])]
    )
    third = torch.quantile(log_volume(outlier), 0.75)
    first = torch.quantile(log_volume(outlier), 0.25)
    expected = int((log_volume(outlier) > third + 1.5 * (third - first)).sum())
    assert run_volume_rule(outlier, threshold_mode="auto")[1][0].split_volume == expected >= 3


def test_the_auto_threshold_does_not_depend_on_the_scale_of_the_scene():
    log_scales = random_gaussians(500, log_scale=(-5, 0.5)).log_scales
    log_scales[:5] += 2.5
    counts = {
        run_volume_rule(log_scales + math.log(k), threshold_mode="auto")[1][0].split_volume
        for k in (0.01, 1, 50)
    }
    assert len(counts) == 1
    assert counts.pop() > 0


@pytest.mark.parametrize(
    "options, key",
    [
        ({"volume_threshold": -1.0}, "densify.volume_threshold"),
        ({"max_condition": 0.5}, "densify.max_condition"),
        ({"interval": 0}, "densify.interval"),
        ({"volume_interval": 150}, "densify.volume_interval"),
        ({"gradient_threshold": 0.0}, "densify.gradient_threshold"),
        ({"max_gaussians": 0}, "densify.max_gaussians"),
        ({"stop": 10}, "densify.stop"),
        ({"threshold_mode": "banana"}, "densify.threshold_mode"),
    ],
)
def test_bad_values_name_their_key(options, key):
    with pytest.raises(ValueError, match=key):
        Volumetric(**options)


def test_admit_chooses_the_best_scores_and_counts_the_refused():
    candidates = torch.tensor([True, True, False, True])
    score = torch.tensor([1.0, 3.0, 9.0, 3.0])
    admitted, refused = admit(candidates, score, 1, 2)
    assert admitted.tolist() == [False, True, False, True]
    assert refused == 1
    every = torch.ones(4, dtype=torch.bool)
    admitted, refused = admit(every, torch.tensor([1.0, 2.0, 3.0, 4.0]), 2, 5)
    assert (admitted.tolist(), refused) == ([False, False, True, True], 2)


@pytest.mark.parametrize(
    "count, most, cap, allowed",
    [
        (5, 10, "hard", 5),
        (12, 10, "hard", 0),
        (12, 10, "curve", 0),
        (12, 10, "soft", 0),
        (10, 10, "soft", None),
        (11, 10, "soft", 0),
        (5, None, "hard", None),
        (12, 10, "freeze", None),
        (12, 10, "governor", None),
    ],
)
def test_each_cap_allows_the_expected_number(count, most, cap, allowed):
    assert allowance(count, most, cap) == allowed


def test_the_volume_rule_can_have_its_own_window():
    own = Volumetric(volume_start=1000, volume_stop=2000, volume_interval=200)
    assert [step for step in range(100, 3000, 100) if own.volume_due(step)] == [
        1200,
        1400,
        1600,
        1800,
    ]
    as_adc = Volumetric(start=1000, stop=1400)
    assert [step for step in range(50, 3000, 50) if as_adc.volume_due(step)] == [1100, 1200, 1300]


@pytest.mark.parametrize("mode", ["quantile", "auto"])
def test_the_threshold_of_an_empty_set_is_infinite(mode):
    assert Volumetric(threshold_mode=mode).log_threshold(torch.zeros(0)) == math.inf
