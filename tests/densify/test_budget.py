"""Caps: a frozen round changes nothing, the governor reaches a count, the training sets a limit."""

import json
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_equal

from gsbench.densify import ADC, MCMC, Budgeted, DensifyContext, Volumetric
from gsbench.densify.budget import find_factor
from tests.densify.helpers import EXTENT, at, generator, to_rows, trained
from tests.densify.test_rounds import prepared
from tests.gaussians.helpers import random_gaussians
from tests.helpers import refusal


@pytest.mark.parametrize("kind", [ADC, Volumetric])
def test_a_frozen_round_neither_grows_nor_prunes(kind):
    """The optimiser step of that iteration is not skipped, as it is after an edit."""
    densifier = kind(max_gaussians=60, cap="freeze")
    trainable, _ = prepared(densifier, 3, count=60)
    # a round that starts at the limit may exceed it
    assert densifier.refine(600, trainable, generator()).after > 60
    trainable.values.opacity_logits.data[:5] = -9.0  # to be pruned
    for tensor in trainable.values.tensors().values():
        tensor.grad = torch.ones_like(tensor)
    densifier.statistics["gradient_sum"] += 1e-3
    densifier.statistics["visible_count"] += 1
    before = to_rows(trainable)
    event = densifier.refine(700, trainable, generator())
    assert_equal(to_rows(trainable), before)
    counts = (event.pruned_opacity, event.cloned, event.split_gradient, event.split_volume)
    assert counts == (0, 0, 0, 0)
    assert trainable.values.means.grad is not None
    assert event.after == event.before

    twin = kind(cap="soft")
    twin.begin(trainable.values.detach(), DensifyContext(EXTENT))
    twin.statistics = densifier.statistics
    unlimited = twin.refine(700, trainable, generator())
    assert unlimited.pruned_opacity >= 5
    assert event.blocked_by_cap == unlimited.after - (unlimited.before - 5) > 0


def test_a_frozen_training_still_resets_its_opacities():
    densifier = ADC(max_gaussians=60, cap="freeze")
    trainable, _ = prepared(densifier, 3, count=60)
    densifier.refine(2900, trainable, generator())
    event = densifier.refine(3000, trainable, generator())
    assert event.before == event.after > 60
    assert event.opacity_reset
    assert float(trainable.values.opacities.detach().max()) < 0.0101


@pytest.mark.parametrize("seed", range(20))
def test_bisection_finds_the_factor_that_meets_the_target(seed):
    draw = np.random.default_rng(seed)
    scores = draw.lognormal(0, 2, 200)
    target = int(draw.integers(0, 200))

    def count(factor):
        return int((scores > factor).sum())

    best = min(abs(count(f) - target) for f in scores)
    assert abs(count(find_factor(count, target, 1e-3, 1e3)) - target) == best == 0
    assert find_factor(count, 0, 1e-3, 1e-2) == pytest.approx(1e-2)  # even the strictest has more
    assert find_factor(count, 300, 1e-3, 1e3) == 1e-3  # even the least strict has fewer


COMBINATIONS = [
    (ADC, {}),
    (ADC, {"split_children": 3, "revised_opacity": True}),
    (ADC, {"gradient": "absolute", "threshold_inclusive": False}),
    (Volumetric, {}),
    (Volumetric, {"split_isotropic": False, "max_condition": 4.0}),
    (Volumetric, {"volume_order": "before_adc", "condition_of": "scales"}),
    (Volumetric, {"volume_order": "after_prune", "volume_children": 3}),
    (Volumetric, {"threshold_mode": "extent_relative", "volume_threshold": 3e-4}),
    (Volumetric, {"volume_interval": 200}),
]


@pytest.mark.parametrize(
    "kind, options", COMBINATIONS, ids=lambda value: getattr(value, "__name__", str(value))
)
def test_the_forecast_is_the_count_after_the_round(kind, options):
    for seed, (step, strictness, cull) in enumerate(
        [(600, 1, 1), (3100, 0.3, 4), (3300, 5, 1), (3200, 0.01, 2)]
    ):
        densifier = kind(**options)
        trainable, _ = prepared(densifier, seed, count=200)
        refinement = replace(at(step, trainable, seed), strictness=strictness, cull=cull)
        foreseen = densifier.forecast(refinement)
        with torch.no_grad():
            for rule in densifier.rules(refinement):
                rule(refinement)
        assert len(trainable) == foreseen


@pytest.mark.parametrize("kind", [ADC, Volumetric, MCMC])
def test_targets_follow_the_curve_and_the_last_one_is_the_limit(kind):
    densifier = kind(start=500, stop=1500, interval=100, max_gaussians=1100, cap="governor")
    count, counts = 100, []
    for step in range(600, 1500, 100):
        count = densifier.target(at(step, range(count)))
        counts.append(count)
    progress = np.arange(1, 10) / 9  # the ninth round is the last
    assert_allclose(counts, 100 + 1000 * (2 * progress - progress**2), atol=1.0)
    assert counts[-1] == 1100
    late = densifier.target(at(1200, range(300)))
    assert late == 300 + round(800 * (1 - (2 / 3) ** 2))  # two rounds are left after it
    assert densifier.target(at(1400, range(late))) == 1100
    densifier.start = 550  # between two rounds: 8.5 rounds from there to the last
    assert densifier.target(at(600, range(100))) == 100 + round(1000 * (1 - (8 / 8.5) ** 2))


@pytest.mark.parametrize(
    "kind, own",
    [(ADC, {}), *((Volumetric, {"governor_dimension": dimension}) for dimension in (1, 3))],
)
def test_a_governed_round_ends_at_its_target(kind, own):
    """One factor gives all thresholds, and the event records it; the test counts what is above."""
    densifier = kind(max_gaussians=450, cap="governor", stop=1200, **own)
    trainable, gradient = prepared(densifier, 2, count=300)
    sizes = np.exp(np.array([row["log_scales"] for row in to_rows(trainable)]))  # [N, 3]
    opacities = trainable.values.opacities.detach().numpy()
    ungoverned = densifier.forecast(at(900, trainable))
    event = densifier.refine(900, trainable, generator())
    factor = event.strictness
    assert factor != 1
    assert event.cull == 1
    assert event.blocked_by_cap == max(0, ungoverned - event.after)
    assert event.target == 300 + round(150 * (1 - (2 / 3) ** 2))
    assert abs(event.after - event.target) <= 2
    assert event.balances()
    over, large = gradient >= 2e-4 * factor, sizes.max(-1) > 0.01 * EXTENT
    assert (event.cloned, event.split_gradient) == ((over & ~large).sum(), (over & large).sum())
    assert event.pruned_opacity >= (opacities < 0.005).sum()
    if own:  # the factor scales the volume threshold or its size
        threshold = 0.03 * factor ** own["governor_dimension"]
        assert event.volume_threshold == pytest.approx(threshold)
        # A Gaussian and its clone have the same volume, and so have the children of a split.
        volumes = 4 / 3 * np.pi * (sizes / np.where(over & large, 1.6, 1)[:, None]).prod(-1)
        assert event.split_volume == np.where(over, 2, 1)[volumes > threshold].sum() > 0
    json.loads(json.dumps(event.as_dict(), allow_nan=False))


def faint_and_governed(count, target):
    """Gaussians with opacities from 0.006 to 0.06, of which none grows."""
    densifier = ADC(max_gaussians=count, cap="governor", gradient_threshold=1.0, prune_size=100.0)
    trainable, _ = prepared(densifier, 5, count=count)
    densifier.max_gaussians = target
    trainable.values.opacity_logits.data[:] = torch.logit(
        torch.linspace(0.006, 0.06, count, dtype=torch.float64)
    )
    return densifier, trainable


def test_far_above_its_target_a_round_prunes_more_faint_gaussians():
    densifier, trainable = faint_and_governed(60, target=30)
    steps = range(3000, 3800, 100)
    assert [*filter(densifier.may_cull, steps)] == [3000, 3600, 3700]  # a reset is at 3000
    assert densifier.may_cull(6000)  # a round resets opacities after it has pruned
    locked = at(3100, trainable)
    densifier.govern(locked)
    assert locked.event.target < 60
    assert locked.event.cull == 1  # although the count is above the target
    opacities = trainable.values.opacities.detach().clone()
    event = densifier.refine(14_900, trainable, generator())  # the last round
    assert event.target == 30
    assert event.strictness == pytest.approx(1e3)
    assert 1 < event.cull <= 10
    assert event.pruned_opacity == int((opacities < 0.005 * event.cull).sum()) > 0
    assert event.after == 60 - event.pruned_opacity == 30


@pytest.mark.parametrize("target, culls", [(199, False), (198, True)])
def test_a_count_up_to_one_percent_above_its_target_is_not_culled(target, culls):
    densifier, trainable = faint_and_governed(200, target)
    event = densifier.refine(14_900, trainable, generator())
    assert (event.cull > 1) == culls
    assert event.after == (target if culls else 200)


def test_governed_rounds_of_mcmc_end_at_their_targets():
    gaussians = random_gaussians(40)
    densifier = MCMC(start=0, stop=301, interval=100, max_gaussians=100, cap="governor")
    densifier.begin(gaussians, DensifyContext(1.0))
    trainable = trained(gaussians, 1.0)
    events = [densifier.refine(step, trainable, generator(step)) for step in (100, 200, 300)]
    assert [event.after for event in events] == [event.target for event in events]
    assert events[-1].after == 100
    assert all(event.cull == 1 for event in events)


@pytest.mark.parametrize("cap", ["freeze", "governor"])
def test_a_cap_that_needs_a_forecast_or_a_limit_is_refused_without_it(cap):
    @dataclass
    class Silent(Budgeted):
        pass

    with refusal(rf"densify\.cap={cap} needs the method forecast, which Silent lacks"):
        Silent(cap=cap)
    with refusal(rf"densify\.max_gaussians must be set for densify\.cap={cap}"):
        ADC(cap=cap, max_gaussians=None)
