"""MCMC and MRNF against restatements, one Gaussian at a time."""

import math

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from gsbench.densify import ADC, MCMC, MRNF, DensifyContext
from gsbench.densify.mcmc import bounds
from gsbench.densify.scores import draw
from tests.densify import restatement
from tests.densify.helpers import EXTENT, assert_same, at, generator, to_rows, trained, with_moments
from tests.densify.restatement import logit, opacity
from tests.densify.test_scores import COUNT, Room, find_edges, over_median, started
from tests.gaussians.helpers import random_gaussians


def drawn(rows, weights, count, rng):
    """Draw with replacement: the places where uniform numbers fall in the cumulative weights."""
    line = np.cumsum(weights)
    numbers = torch.rand(count, generator=rng, dtype=torch.float64).numpy() * line[-1]
    return [next(i for i in range(len(rows)) if line[i] > number) for number in numbers]


def shared(row, copies):
    """Opacity and scale of each of ``copies`` copies (eq. 9), with moments of zero."""
    o, n = opacity(row), min(copies, 50)
    new = 1 - (1 - o) ** (1 / n)
    total = sum(
        math.comb(i - 1, k) * (-1) ** k * new ** (k + 1) / math.sqrt(k + 1)
        for i in range(1, n + 1)
        for k in range(i)
    )
    kept = max(0.005, min(new, 1 - 1e-6))
    wider = row["log_scales"] + math.log(o / total)
    return restatement.newborn(row, log_scales=wider, opacity_logits=np.array(logit(kept)))


def with_copies(rows, sources):
    counts = {i: sources.count(i) + 1 for i in set(sources)}
    sharing = [shared(row, counts[i]) if i in counts else row for i, row in enumerate(rows)]
    return sharing + [
        {name: np.array(value) for name, value in sharing[i].items()} for i in sources
    ]


def prepared(count, seed, **options):
    gaussians = random_gaussians(count, seed)
    gaussians.opacity_logits[: count // 4] = -9.0
    densifier, trainable = MCMC(**options), with_moments(gaussians)
    densifier.begin(trainable.values.detach(), DensifyContext(4.0))
    return densifier, trainable


@pytest.mark.parametrize("growth", [0.05, 0.5])
@pytest.mark.parametrize("seed", range(3))
def test_a_round_of_mcmc_matches_the_restatement(seed, growth):
    densifier, trainable = prepared(40, seed, max_gaussians=55, growth=growth)
    rows = to_rows(trainable)
    event = densifier.refine(600, trainable, generator(seed))
    rng = generator(seed)
    dead = [opacity(row) <= 0.005 for row in rows]
    weights = [0.0 if gone else opacity(row) for row, gone in zip(rows, dead, strict=True)]
    sources = drawn(rows, weights, sum(dead), rng)
    place = np.cumsum([not gone for gone in dead]) - 1  # index of each living one among the living
    alive = [row for row, gone in zip(rows, dead, strict=True) if not gone]
    rows = with_copies(alive, [int(place[i]) for i in sources])
    more = min(int((1 + growth) * 40), 55) - 40
    rows = with_copies(rows, drawn(rows, [opacity(row) for row in rows], more, rng))
    assert_same(trainable, rows)
    assert (event.relocated, event.added) == (10, more)


def test_the_noise_of_mcmc_matches_the_formula():
    """R S S R^T times a normal draw, sigmoid(-100 (o - 0.005)), 5e5 and the means' rate."""
    densifier, trainable = prepared(40, 1)
    trainable.values.opacity_logits.data.copy_(torch.linspace(-9, 2, 40))
    trainable.set_step(1)
    rows = to_rows(trainable)
    densifier.after_step(1, trainable, generator(0))
    noise = torch.randn(40, 3, generator=generator(), dtype=torch.float64).numpy()
    for i, row in enumerate(rows):
        axes = restatement.rotation(row["quaternions"]) * np.exp(row["log_scales"])
        gate = 1 / (1 + np.exp(100 * (opacity(row) - 0.005)))
        row["means"] += axes @ axes.T @ noise[i] * gate * 5e5 * trainable.position_rate
    assert_same(trainable, rows)


def scored(values):
    """The largest refine weight [N] over the three views, and the factor for edges [N].

    The factor is 1 + 0.25 times the mean edge score divided by its median.
    """
    room, weight, edge = Room(), np.zeros(COUNT), np.zeros(COUNT)
    for view, image, blended in room.shown(values):
        error = room.dissimilarity(view, image).numpy()
        weight = np.maximum(weight, (blended * error / error.mean()).sum((1, 2)))
        edge += over_median((blended * find_edges(room.images[view])).sum((1, 2))) / 3
    return weight, 1 + 0.25 * over_median(edge)


def decayed(row, left):
    return row | {
        "opacity_logits": np.array(logit(opacity(row) - 0.004 * left)),
        "log_scales": row["log_scales"] + np.log(1 - 0.002 * left),
    }


def placed(densifier, seed):
    """Gaussians with moments, in a room with views."""
    trainable, _ = started(ADC(), seed)
    densifier.begin(trainable.values.detach(), DensifyContext(EXTENT, views=Room()))
    return trainable


def begun(densifier, seed):
    trainable = placed(densifier, seed)
    trainable.values.opacity_logits.data[:6] = -7.0  # transparent
    trainable.values.means.data[6, 0] = 1e6  # far outside the scene
    seen = np.random.default_rng(seed).random(COUNT) < 0.8
    densifier.statistics = {"seen": torch.from_numpy(seen)}
    return trainable, seen


@pytest.mark.parametrize("step, room", [(600, 1000), (600, 5), (600, 0), (16_000, 1000)])
def test_a_round_of_mrnf_matches_the_restatement(step, room):
    densifier = MRNF(max_gaussians=COUNT + room, growth_share=0.4, growth_threshold=0.5)
    trainable, seen = begun(densifier, 1)
    rows, (weight, guidance) = to_rows(trainable), scored(trainable.values.detach())
    event = densifier.refine(step, trainable, generator(0))

    rng = generator(0)
    torch.randperm(3, generator=rng)  # the views: all three
    opacities = np.array([opacity(row) for row in rows])
    gone = (opacities < 1 / 255) | (np.arange(COUNT) == 6)
    assert gone.sum() == 7
    above = (weight > 0.5) & seen
    wanted = int(0.4 * above.sum() + 0.5)
    assert wanted > 9
    weights = torch.from_numpy(opacities * guidance)
    refilled = draw(torch.from_numpy(seen & ~gone), weights, 7, rng).numpy()
    left = min(wanted - 7, room) if step < 15_000 else 0
    grown = draw(
        torch.from_numpy(above & ~gone & ~refilled), torch.from_numpy(weight * guidance), left, rng
    ).numpy()
    split = refilled | grown
    assert (event.pruned_opacity, event.split_gradient) == (7, split.sum())
    assert split.sum() == 7 + left
    assert event.blocked_by_cap == (wanted - 7 - left if step < 15_000 else 0)
    # a child is half a standard deviation away
    children = [
        restatement.half(rows[i], side, 0.5, 0.5, 0.85)
        for side in (1, -1)
        for i in np.nonzero(split)[0]
    ]
    kept = [row for i, row in enumerate(rows) if not split[i] and not gone[i]]
    assert_same(trainable, [decayed(row, 1 - step / 30_000) for row in kept + children])
    assert event.balances()
    assert not densifier.statistics["seen"].any()


def test_without_growth_mrnf_still_replaces_pruned_gaussians():
    densifier = MRNF(growth_share=0.0)
    trainable, _ = begun(densifier, 1)
    event = densifier.refine(600, trainable, generator(0))
    assert (event.pruned_opacity, event.split_gradient, event.after) == (7, 7, COUNT)


def test_decay_ends_and_keeps_opaque_gaussians_finite():
    densifier = MRNF(decay_until=1000)
    trainable = placed(densifier, 0)
    before = trainable.values.log_scales.detach().clone()
    for step, remaining in ((500, 0.5), (1000, 0.0), (2000, 0.0)):
        trainable.values.log_scales.data.copy_(before)
        with torch.no_grad():
            densifier.decay(at(step, trainable))
        shrunk = (trainable.values.log_scales - before).exp()
        assert_close(shrunk, torch.full_like(shrunk, 1 - 0.002 * remaining))
    single = trained(random_gaussians(3, dtype=torch.float32))
    single.values.opacity_logits.data[:] = torch.tensor([50.0, -50.0, 0.0])
    with torch.no_grad():
        densifier.decay(at(1000, single))
    expected = [math.log((1 - 2**-23) / 2**-23), math.log(1e-12), 0.0]
    assert single.values.opacity_logits.tolist() == pytest.approx(expected, abs=0.1)


def test_mrnf_has_a_round_every_200_iterations_until_its_window_ends():
    densifier = MRNF(stop=1000)
    trainable, _ = begun(densifier, 0)
    due = [step for step in range(1, 1100) if densifier.refine(step, trainable, generator())]
    assert due == [200, 400, 600, 800]


def test_gaussians_larger_than_the_scene_or_too_small_are_pruned():
    densifier = MRNF()
    trainable = placed(densifier, 0)
    half_size = bounds(trainable.values.means.detach())[1]
    trainable.values.log_scales.data[3, 1] = np.log(101 * half_size)
    trainable.values.log_scales.data[4, 2] = np.log(0.9e-10)
    trainable.values.log_scales.data[5] = np.log(99 * half_size)
    assert densifier.to_prune(trainable.values).nonzero().squeeze(-1).tolist() == [3, 4]


def test_the_bounds_hold_the_central_four_fifths():
    means = torch.tensor([[i, 10.0 * i, -i] for i in range(101)], dtype=torch.float64)
    center, half_size, middle = bounds(means[torch.randperm(101, generator=generator(0))])
    assert center.tolist() == [50, 500, -50]
    assert (half_size, middle) == (400, 80)


def test_the_noise_of_mrnf_moves_faint_seen_gaussians_and_is_limited():
    densifier, gaussians = MRNF(), random_gaussians(300, 2)
    gaussians.opacity_logits[:100], gaussians.opacity_logits[100:] = -9.0, 2.0
    trainable = trained(gaussians)
    densifier.begin(gaussians, DensifyContext(4.0))
    densifier.statistics["seen"][:200] = True
    densifier.statistics["seen"][50:100] = False
    trainable.set_step(1)
    before = trainable.values.means.detach().clone()
    densifier.after_step(1, trainable, generator(0))
    moved = trainable.values.means.detach() - before
    weight = (1 - 1 / (1 + math.exp(9))) ** 150 * 50 * trainable.position_rate
    assert float(moved[:50].std()) == pytest.approx(weight, rel=0.15)
    assert not moved[50:100].any()
    assert moved[100:].abs().max() < 1e-30
    wild = MRNF(noise_rate=1e9)
    wild.begin(gaussians, DensifyContext(4.0))
    wild.statistics["seen"][:] = True
    before = trainable.values.means.detach().clone()
    size = bounds(before)[2]
    wild.after_step(wild.stop, trainable, generator(0))
    assert torch.equal(trainable.values.means, before)  # no more noise after the window
    wild.after_step(1, trainable, generator(0))
    assert float((trainable.values.means.detach() - before).abs().max()) == pytest.approx(size)
