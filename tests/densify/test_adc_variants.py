"""Variants of ADC against restatements, one Gaussian at a time."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from torch.testing import assert_close

from gsbench.densify import AbsGS, DensifyContext, PixelGS, QuantileADC, ResGS, SteepGS
from gsbench.raster.base import Footprint
from tests.densify import restatement
from tests.densify.helpers import (
    EXTENT,
    Round,
    around_a_reset,
    at,
    gathered,
    generator,
    rendered,
    with_moments,
)
from tests.densify.restatement import logit, opacity
from tests.densify.test_rounds import prepared
from tests.gaussians.helpers import random_gaussians


def absgs_growth(rows, signed, absolute, noise):
    """Copy small Gaussians where signed >= 0.0002, split large ones where absolute >= 0.0004.

    A Gaussian is large if a scale is above 0.001 of the extent. A split divides the scales by 1.6.
    Returns the rows, and the numbers of copied and of split Gaussians.
    """
    large = [restatement.size(row) > 0.001 * EXTENT for row in rows]
    clones = [i for i in range(len(rows)) if not large[i] and signed[i] >= 0.0002]
    chosen = [i for i in range(len(rows)) if large[i] and absolute[i] >= 0.0004]
    rows = rows + [restatement.newborn(rows[i]) for i in clones]
    return restatement.split_all(rows, chosen, noise), len(clones), len(chosen)


@around_a_reset
@pytest.mark.parametrize("seed", range(3))
def test_a_round_of_absgs_matches_the_restatement(seed, step):
    densifier = AbsGS()
    trainable, _ = prepared(densifier, seed)
    trainable.values.log_scales.data[::4] -= 4.0  # a quarter is too small for a split
    draw = np.random.default_rng(seed)
    signed, absolute = draw.uniform(0, 4e-4, 60), draw.uniform(0, 8e-4, 60)
    gathered(densifier, signed, absolute)
    real = Round(densifier, trainable, step, seed)
    rows, cloned, split = absgs_growth(real.rows, signed, absolute, real.noise)
    assert (real.event.cloned, real.event.split_gradient) == (cloned, split)
    assert min(cloned, split) > 0
    real.check(rows)


def test_absgs_gathers_both_gradients():
    densifier = AbsGS()
    _, mean = prepared(densifier, 0)  # its renders have equal gradients of both kinds
    assert_allclose(densifier.mean_gradient(), mean, rtol=1e-6)
    assert_allclose(densifier.mean_absolute_gradient(), mean, rtol=1e-6)
    assert densifier.needs_absolute_gradient


def test_every_500_iterations_opacities_are_lowered_to_the_ceiling():
    densifier = AbsGS()
    trainable, _ = prepared(densifier, 1)
    before = trainable.values.opacities.detach().clone()
    event = densifier.refine(500, trainable, generator())  # no round yet
    assert (before > 0.8).any()
    assert_close(trainable.values.opacities.detach(), before.clamp_max(0.8))
    assert not trainable.adam["opacity_logits"].first.any()
    assert not event.opacity_reset
    assert densifier.refine(15_000, trainable, generator()) is None
    assert densifier.refine(501, trainable, generator()) is None
    refinement = at(3000, trainable)
    assert densifier.rules(refinement)[-2:] == [densifier.lower_opacity, densifier.reset_opacity]
    densifier.refine(3000, trainable, generator())
    assert float(trainable.values.opacities.detach().max()) == pytest.approx(0.01)


def test_under_a_hard_cap_absgs_grows_the_gaussians_farthest_above_their_threshold():
    densifier = AbsGS(max_gaussians=62, cap="hard", prune_opacity=0.0)
    trainable, _ = prepared(densifier, 1)
    trainable.values.log_scales.data[:30] = -9.0
    # 1.5 and 1.25 times their thresholds
    signed, absolute = torch.full((60,), 3e-4), torch.full((60,), 5e-4)
    signed[7], absolute[50] = 9e-4, 2e-3
    gathered(densifier, signed, absolute)
    event = densifier.refine(600, trainable, generator())
    assert (event.cloned, event.split_gradient) == (1, 1)


COUNT = 60
VIEWS = 4


class Views:
    """Made-up gradients [V, N, 2], pixels, depths and radii [V, N] of a few views."""

    def __init__(self, seed):
        rng = np.random.default_rng(seed)
        self.gradients = rng.exponential(2e-4, (VIEWS, COUNT, 2))
        self.pixels = rng.integers(0, 400, (VIEWS, COUNT)) * (rng.random((VIEWS, COUNT)) < 0.7)
        self.depths = rng.uniform(-1, 1.5 * EXTENT, (VIEWS, COUNT))
        self.radii = np.where(self.pixels > 0, 3, rng.integers(0, 2, (VIEWS, COUNT)))

    def show(self, densifier, trainable):
        densifier.begin(trainable.values.detach(), DensifyContext(EXTENT))
        for view in range(VIEWS):
            none, covered = torch.empty(0), torch.from_numpy(self.pixels[view].astype(np.int32))
            footprint = Footprint(covered, torch.from_numpy(self.depths[view]), none, none)
            render = rendered(self.gradients[view], self.radii[view])
            render.footprint = lambda values=None, f=footprint: f
            densifier.observe(view + 1, render)

    def mean_gradient(self, fraction):
        """The growth condition of the paper, term by term."""
        means = np.zeros(COUNT)
        for i in range(COUNT):
            above = below = 0.0
            for k in range(VIEWS):
                m, near = self.pixels[k, i], (fraction or np.nan) * EXTENT
                f = 1.0 if fraction is None else min((self.depths[k, i] / near) ** 2, 1)
                above += m * f * np.hypot(*self.gradients[k, i])
                below += m
            means[i] = above / below if below else 0
        return means


def started(seed, densifier):
    trainable = with_moments(random_gaussians(COUNT, seed, log_scale=(-6.0, 0.3)))
    views = Views(seed)
    views.show(densifier, trainable)
    return trainable, views


@pytest.mark.parametrize("fraction", [0.37, 1.0, None])
@pytest.mark.parametrize("seed", range(3))
def test_a_round_of_pixel_gs_matches_the_restatement(seed, fraction):
    densifier = PixelGS(near_fraction=fraction)
    trainable, views = started(seed, densifier)
    gradient = views.mean_gradient(fraction)
    assert_allclose(densifier.mean_gradient(), gradient, rtol=1e-5)
    real = Round(densifier, trainable, 3100, seed)
    real.check(real.grown(gradient))
    assert min(real.event.cloned, real.event.split_gradient) > 0
    assert not densifier.statistics["pixel_sum"].any()  # reset after the round


def test_under_a_hard_cap_pixel_gs_grows_the_largest_weighted_gradients():
    densifier = PixelGS(max_gaussians=COUNT + 5, cap="hard", prune_opacity=0.0)
    trainable, views = started(1, densifier)
    assert densifier.refine(600, trainable, generator()).after == COUNT + 5
    parents = densifier.lineage.state_dict()["parents"][COUNT:].unique()
    largest = np.argsort(-views.mean_gradient(0.37), kind="stable")[:5]
    assert sorted(parents.tolist()) == sorted(largest.tolist())


def test_a_render_without_a_footprint_is_refused():
    densifier = PixelGS()
    densifier.begin(random_gaussians(2), DensifyContext(1.0))
    with pytest.raises(RuntimeError, match="footprint"):
        densifier.observe(1, rendered(torch.zeros(2, 2)))


@around_a_reset
@pytest.mark.parametrize("rate", [0.1, 0.5, 3.0])
def test_a_round_of_quantile_adc_matches_the_restatement(rate, step):
    """The share with the largest gradients grows as in ADC; Gaussians without a gradient do not.

    Then the faintest share is pruned.
    """
    densifier = QuantileADC(growth_rate=rate, prune_share=0.05)
    trainable, _ = prepared(densifier, 4)
    draws = np.random.default_rng(4)
    gradient = draws.uniform(0, 1e-6, 60) * (draws.random(60) < 0.8)
    gathered(densifier, gradient)
    event = (real := Round(densifier, trainable, step, 4)).event
    places = min(int(60 * rate), int((gradient > 0).sum()))
    chosen = np.zeros(60)
    chosen[np.argsort(-gradient, kind="stable")[:places]] = 1
    assert event.cloned + event.split_gradient == places
    rows = real.grown(chosen)
    limit = np.quantile([row["opacity_logits"] for row in rows], 0.05)
    bright = [row for row in rows if row["opacity_logits"] >= limit]
    most = 0.1 * EXTENT if step > 3000 else np.inf
    real.check([row for row in bright if restatement.size(row) <= most], pruned=True)
    assert event.pruned_opacity == len(rows) - len(bright) > 0


def test_the_faintest_share_is_pruned_and_an_empty_set_is_accepted():
    densifier, logits = QuantileADC(prune_share=0.1), torch.arange(11.0)
    for cull, faint in ((1.0, 1), (3.0, 3)):
        assert densifier.faint(logits, cull).tolist() == [True] * faint + [False] * (11 - faint)
    assert densifier.faint(logits[:0], 1.0).shape == (0,)
    assert densifier.faint(logits[:1], 1.0).tolist() == [False]


def test_a_governed_round_of_quantile_adc_ends_at_its_target():
    densifier = QuantileADC(max_gaussians=80, cap="governor", start=500, stop=1200, prune_share=0.0)
    trainable, _ = prepared(densifier, 2)
    densifier.statistics["gradient_sum"] += 1e-6
    event = densifier.refine(1100, trainable, generator())
    assert event.target == event.after == 80


def least(matrix):
    values, vectors = np.linalg.eigh(matrix)
    vector = vectors[:, 0]
    return float(values[0]), vector * np.sign(vector[np.abs(vector).argmax()])


def steep_gs_growth(rows, gradient, matrices, noise, rate, threshold, share):
    """Split Gaussians with a gradient of at least 0.0002 and an eigenvalue below ``threshold``.

    Their halves lie on either side of the parent along the least eigenvector. The halves of a large
    parent have its scales / 1.6, and each distance is the length of a draw. The halves of a small
    parent have its scales, at the distance ``rate``. Returns the rows and the number of parents.
    """
    chosen = [
        i
        for i in range(len(rows))
        if gradient[i] >= 0.0002 and least(matrices[i])[0] * EXTENT * EXTENT < threshold
    ]

    def half(i, side):
        scales, draw = np.exp(rows[i]["log_scales"]), next(noise)
        large = scales.max() > 0.01 * EXTENT
        length = np.sqrt(((draw * scales) ** 2).sum()) if large else rate
        new = np.log(scales / 1.6) if large else rows[i]["log_scales"]
        mean = rows[i]["means"] + side * length * least(matrices[i])[1]
        child = restatement.newborn(rows[i], means=mean, log_scales=new)
        return restatement.with_logit(child, logit(share * opacity(rows[i])))

    return restatement.halve_all(rows, chosen, half), len(chosen)


def given(densifier, seed, count=60):
    """Set the statistics of three visible iterations.

    Returns gradients [N] and symmetric splitting matrices [N, 3, 3] per iteration.
    """
    draw = np.random.default_rng(seed)
    gradient = draw.uniform(0, 4e-4, count)
    matrices = draw.normal(0, 1e-5, (count, 3, 3)) + 1e-5 * np.eye(3)
    matrices += matrices.transpose(0, 2, 1)
    densifier.statistics["gradient_sum"] = torch.from_numpy(3 * gradient)
    densifier.statistics["splitting_sum"] = torch.from_numpy(3 * matrices)
    densifier.statistics["visible_count"][:] = 3
    return gradient, matrices


@around_a_reset
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("threshold, share", [(-1e-6, 0.5), (None, 1.0)])
def test_a_round_of_steep_gs_matches_the_restatement(seed, step, threshold, share):
    densifier = SteepGS(eigenvalue_threshold=threshold, opacity_factor=share)
    trainable, _ = prepared(densifier, seed)
    trainable.values.log_scales.data[::4] -= 3.0  # small ones, too
    trainable.set_step(step)
    gradient, matrices = given(densifier, seed)
    rate = trainable.position_rate
    real = Round(densifier, trainable, step, seed)
    growing = (gradient >= 0.0002).sum()
    limit = np.inf if threshold is None else threshold
    inputs = real.rows, gradient, matrices, real.noise, rate
    rows, chosen = steep_gs_growth(*inputs, limit, share)
    assert 0 < chosen == real.event.split_gradient
    assert (chosen == growing) == (threshold is None)
    real.check(rows)
    assert not densifier.statistics["splitting_sum"].any()
    assert densifier.statistics["splitting_sum"].shape == (len(trainable), 3, 3)


def test_under_a_hard_cap_steep_gs_splits_the_least_eigenvalues_first():
    densifier = SteepGS(max_gaussians=63, cap="hard", prune_opacity=0.0)
    trainable, _ = prepared(densifier, 2)
    gradient, matrices = given(densifier, 2)
    order = [i for i in np.argsort([least(m)[0] for m in matrices]) if gradient[i] >= 0.0002]
    before = trainable.values.sh_dc.detach().clone()
    event = densifier.refine(600, trainable, generator())
    assert (event.split_gradient, event.after) == (3, 63)
    assert event.blocked_by_cap > 0
    kept = {tuple(row) for row in trainable.values.sh_dc.detach()[:57].tolist()}
    assert {i for i in range(60) if tuple(before[i].tolist()) not in kept} == set(order[:3])


def test_a_round_of_steep_gs_computes_eigenvectors_once(monkeypatch):
    densifier = SteepGS()
    trainable, _ = prepared(densifier, 1)
    gradient, _ = given(densifier, 1)
    solve, sizes = torch.linalg.eigh, []

    def counting(matrices):
        sizes.append(len(matrices))
        return solve(matrices)

    monkeypatch.setattr(torch.linalg, "eigh", counting)
    densifier.refine(600, trainable, generator())
    assert sizes == [(gradient >= 0.0002).sum()]


def test_splitting_matrices_are_summed():
    densifier = SteepGS()
    trainable, _ = prepared(densifier, 0)
    count = len(trainable)
    before = densifier.statistics["splitting_sum"].clone()
    probe = torch.zeros(count, 3, 3, requires_grad=True)
    probe.grad = torch.arange(9.0).reshape(3, 3).expand(count, 3, 3)
    render = rendered(torch.zeros(count, 2), extra=probe)
    for step in (7, 8):
        densifier.observe(step, render)
    assert_close(densifier.statistics["splitting_sum"] - before, 2 * probe.grad)
    render.extra = None
    with pytest.raises(RuntimeError, match="extra=NAME"):
        densifier.observe(9, render)


WINDOW = {"start": 700, "stop": 12_000}  # that of the authors' code


def residual_split(rows, gradient, stage, noise):
    """Add a child to Gaussians whose gradient reaches 0.00067 min(1, 2^((level - stage) / 3)).

    The parent keeps 0.3 of its opacity. The child's mean is drawn from the parent's density; its
    scales are the parent's / 1.6, its opacity is the parent's former one.
    """
    parents, children = [], []
    for i, row in enumerate(rows):
        level = row["level"]
        if gradient[i] < 0.00067 * min(2 ** ((level - stage) / 3), 1):
            parents.append(row)
            continue
        scales = np.exp(row["log_scales"])
        offset = restatement.rotation(row["quaternions"]) @ (scales * next(noise))
        child = {"means": row["means"] + offset, "log_scales": np.log(scales / 1.6)}
        children.append(restatement.newborn(row, **child, level=level + 1))
        parents.append(restatement.with_logit(row, logit(0.3 * opacity(row))))
    return parents + children


@pytest.mark.parametrize("step, stage", [(800, 1), (2400, 3), (4100, 5)])
@pytest.mark.parametrize("seed", range(2))
def test_a_round_of_res_gs_matches_the_restatement(seed, step, stage):
    densifier = ResGS(**WINDOW)
    trainable, _ = prepared(densifier, seed)
    draw = np.random.default_rng(seed)
    gradient, levels = draw.uniform(0, 1e-3, 60), draw.integers(0, 8, 60)
    gathered(densifier, gradient)
    densifier.statistics["level"] = torch.from_numpy(levels.astype(np.int32))
    real = Round(densifier, trainable, step, seed)
    event = real.event
    noise = torch.randn(event.split_gradient, 3, generator=generator(seed), dtype=torch.float64)
    for row, level in zip(real.rows, levels, strict=True):
        row["level"] = level
    grown = residual_split(real.rows, gradient, stage, iter(noise.numpy()))
    assert event.split_gradient == len(grown) - len(real.rows) > 0
    kept = [row for row in grown if opacity(row) >= 0.005]
    expected = [row.pop("level") for row in kept]
    real.check(kept, pruned=True)
    assert (event.pruned_opacity, event.pruned_size, event.cloned) == (len(grown) - len(kept), 0, 0)
    assert densifier.statistics["level"].tolist() == expected  # levels survive the round
    assert not densifier.statistics["gradient_sum"].any()


def test_the_stages_are_those_of_the_authors_loop():
    """The test runs the authors' counters, one iteration after another.

    Phases end at 2,500 and 6,000, with a pause of 500 iterations after each; a phase has three
    stages.
    """
    changes, level, warm, last, ahead = [2500, 6000], 1, 0, 700, 2500
    count = (ahead - last) // 3
    stages, paused, reached = {}, {}, 0
    for step in range(1, 12_000):
        stages[step], paused[step] = level, warm != 0
        if step in changes:
            reached += 1
            warm, last = 500, step + 500
            ahead = changes[reached] if reached < 2 else 12_000
            level, count = 3 * reached + 1, (ahead - last) // 3
        if warm:
            warm -= 1
        if count and not warm and 700 < step < 12_000:
            count -= 1
            if count == 0:
                level += 1
                count = (ahead - last) // 3
    densifier = ResGS(**WINDOW)
    for step in range(800, 12_000, 100):
        assert densifier.warming_up(step) == paused[step], step
        if not paused[step]:
            assert densifier.stage(step) == stages[step], step
    assert {stages[step] for step in range(800, 12_000, 100)} == set(range(1, 10))


def test_after_the_first_phase_all_opacities_fade_every_500_iterations():
    densifier = ResGS(**WINDOW)
    faded, pruned = [], []
    for step in range(500, 26_000, 500):
        trainable, _ = prepared(densifier, 3)
        densifier.statistics["gradient_sum"].zero_()
        before = trainable.values.opacities.detach().clone()
        event = densifier.refine(step, trainable, generator())
        if event is None:
            continue
        kept = before[before >= 0.005] if event.pruned_opacity else before
        ratio = trainable.values.opacities.detach() / kept
        assert not event.opacity_reset
        if (ratio < 0.9).any():
            assert_close(ratio, torch.full_like(ratio, 0.8))
            assert not trainable.adam["opacity_logits"].first.any()
            faded.append(step)
            if step >= 12_000:
                pruned.append(event.pruned_opacity)
    # The authors' code has raised its level before it tests for this. So opacities fade 45 times.
    assert faded == list(range(2500, 25_000, 500))
    assert min(pruned) > 0


def test_a_short_window_has_no_pause():
    densifier = ResGS(start=200, stop=1000)
    stages = [densifier.stage(step) for step in range(300, 1000, 100)]
    assert stages == sorted(stages)
    assert not any(map(densifier.warming_up, range(1000)))
    # Phases end at 1 and 3: too short for three stages, each of which takes one iteration.
    shortest = ResGS(start=0, stop=6, interval=1, phase_ends=[0.2, 0.5])
    assert [shortest.stage(step) for step in (1, 2, 3, 4)] == [1, 6, 7, 9]


@pytest.mark.parametrize("most, cap, target", [(90, "governor", 90), (63, "hard", None)])
def test_a_capped_round_of_res_gs_ends_at_its_target(most, cap, target):
    densifier = ResGS(max_gaussians=most, cap=cap, start=500, stop=1200)
    trainable, _ = prepared(densifier, 2)
    trainable.values.opacity_logits.data[:] = 1.0
    gathered(densifier, 2e-5 * torch.arange(60))
    event = densifier.refine(1100, trainable, generator())
    assert (event.split_gradient, event.after, event.target) == (most - 60, most, target)
    assert event.blocked_by_cap > 0
