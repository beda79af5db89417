"""Whole refinement rounds give the Gaussians, moments and events of the slow restatement."""

import numpy as np
import pytest
import torch

from gsbench.densify import ADC, MCMC, MRNF, DensifyContext, Volumetric
from gsbench.train.options import TrainConfig
from tests.densify import restatement
from tests.densify.helpers import (
    EXTENT,
    Round,
    around_a_reset,
    at,
    generator,
    noise_of,
    rendered,
    trained,
)
from tests.gaussians.helpers import random_gaussians


def prepared(densifier, seed, count=60):
    """Gaussians with different Adam moments, after three observed iterations.

    Also returns the mean gradient of each.
    """
    rng = np.random.default_rng(seed)
    gaussians = random_gaussians(count, seed, log_scale=(-6.0, 0.3))
    gaussians.opacity_logits.copy_(torch.from_numpy(rng.uniform(-8, 3, count)))
    trainable = trained(gaussians)
    for _ in range(2):
        for tensor in trainable.values.tensors().values():
            tensor.grad = torch.from_numpy(rng.normal(size=tensor.shape) * 1e-3)
        trainable.optimizer_step()
    densifier.begin(trainable.values.detach(), DensifyContext(EXTENT))
    total, seen = np.zeros(count), np.zeros(count)
    for step in range(1, 4):
        gradient, radii = observe(densifier, trainable, rng, step)
        total += np.where(radii > 0, np.hypot(*gradient.T), 0)
        seen += radii > 0
    return trainable, total / np.maximum(seen, 1)


def observe(densifier, trainable, rng, step):
    """Let the densifier observe a made-up render; return its gradients [N, 2] and radii [N]."""
    count = len(trainable)
    gradient, radii = rng.exponential(2e-4, (count, 2)), rng.integers(0, 3, count)
    probe = torch.zeros(count, 3, 3, dtype=torch.float64, requires_grad=True)
    probe.grad = torch.zeros_like(probe)
    densifier.observe(step, rendered(gradient, radii, torch.from_numpy(gradient), extra=probe))
    return gradient, radii


@pytest.mark.parametrize("seed", range(6))
@around_a_reset
def test_a_round_of_adc_matches_the_restatement(seed, step):
    trainable, gradient = prepared(densifier := ADC(), seed)
    real = Round(densifier, trainable, step, seed)
    real.check(real.grown(gradient))
    assert min(real.event.cloned, real.event.split_gradient) > 0


@pytest.mark.parametrize("seed", range(2))
def test_a_round_by_absolute_gradient_matches_the_restatement(seed):
    """It is a round of ADC with another gradient and four times the threshold."""
    densifier = ADC(gradient="absolute", gradient_threshold=0.0008)
    trainable, gradient = prepared(densifier, seed)
    densifier.statistics["gradient_sum"] *= 4
    real = Round(densifier, trainable, 600, seed)
    real.check(real.grown(gradient))


@pytest.mark.parametrize("seed", range(2))
def test_a_round_with_revised_opacity_matches_the_restatement(seed):
    """Clone, original and children of a split each have the opacity 1 - sqrt(1 - o)."""
    trainable, gradient = prepared(densifier := ADC(revised_opacity=True), seed)
    real = Round(densifier, trainable, 600, seed)
    for i, row in enumerate(real.rows):
        if gradient[i] >= 0.0002:
            revised = restatement.logit(1 - np.sqrt(1 - restatement.opacity(row)))
            real.rows[i] = restatement.with_logit(row, revised)
    real.check(real.grown(gradient))


@pytest.mark.parametrize("seed", range(2))
@around_a_reset
@pytest.mark.parametrize(
    "order, threshold, isotropic",
    [("after_adc", 0.03, True), ("after_prune", 0.003, True), ("after_adc", 0.03, False)],
)
def test_a_volumetric_round_matches_the_restatement(order, threshold, isotropic, seed, step):
    densifier = Volumetric(
        volume_threshold=threshold, volume_order=order, split_isotropic=isotropic
    )
    trainable, gradient = prepared(densifier, seed)
    real = Round(densifier, trainable, step, seed)
    rows = real.grown(gradient)
    pruned = order == "after_prune"
    if pruned:
        rows = restatement.prune(rows, step, EXTENT, real.counts)
        assert real.event.pruned_opacity > 0
    rows = restatement.volume_growth(rows, threshold, real.noise, real.counts, isotropic)
    real.check(rows, pruned)
    assert real.event.split_volume > 0


@pytest.mark.parametrize("seed", range(6))
@around_a_reset
def test_volumes_may_be_split_before_the_gradient_rule(seed, step):
    densifier = Volumetric(volume_threshold=0.03, volume_order="before_adc")
    trainable, gradient = prepared(densifier, seed)
    real = Round(densifier, trainable, step, seed)
    real.noise = noise_of(seed, real.event.split_volume, real.event.split_gradient)
    sizes = np.exp([row["log_scales"] for row in real.rows])
    rows = restatement.volume_growth(real.rows, 0.03, real.noise, real.counts)
    # the children have no gradient yet
    staying = gradient[4 / 3 * np.pi * sizes.prod(-1) <= 0.03]
    gradient = np.concatenate([staying, np.zeros(len(rows) - len(staying))])
    real.check(real.grown(gradient, rows))
    assert min(real.event.split_volume, real.event.split_gradient) > 0


SWITCHES = {
    "gradient": ["signed", "absolute"],
    "threshold_inclusive": [True, False],
    "split_children": [2, 3],
    "revised_opacity": [False, True],
    "prune_screen_radius": [None, 1.0],
    "max_gaussians": [None, 90],
    "cap": ["soft", "hard", "curve"],
    "threshold_mode": ["absolute", "extent_relative", "quantile", "auto"],
    "condition_of": ["eigenvalues", "scales", "nothing"],
    "max_condition": [None, 1.0, 4.0],
    "split_isotropic": [True, False],
    "volume_children": [2, 3],
    "keep_parent": [False, True],
    "placement": ["sampled", "parent_mean"],
    "volume_order": ["after_adc", "before_adc", "after_prune"],
    "volume_interval": [None, 200],
}


@pytest.mark.parametrize("seed", range(80))
def test_any_combination_of_options_runs_through_several_rounds(seed):
    """Options are drawn at random; all seeds together cover all pairs.

    Every event balances, values stay finite, and an exact cap is kept.
    """
    rng = np.random.default_rng(seed)
    options = {name: values[rng.integers(len(values))] for name, values in SWITCHES.items()}
    if options["cap"] == "curve":
        options["max_gaussians"] = 90
    densifier = Volumetric(**options)
    trainable, _ = prepared(densifier, seed)
    rng_of_rules = generator(seed)
    for step in (2900, 3000, 3100, 3200):
        observe(densifier, trainable, rng, step)
        event = densifier.refine(step, trainable, rng_of_rules)
        assert event.balances()
        assert event.after == len(trainable) == len(densifier.lineage.ids)
        assert event.after == len(densifier.statistics["gradient_sum"])
        assert all(torch.isfinite(tensor).all() for tensor in trainable.values.tensors().values())
        if options["max_gaussians"] is not None and options["cap"] != "soft":
            assert len(trainable) <= 90


def test_the_optimizer_skips_the_step_after_a_refinement_and_takes_the_next():
    densifier = ADC()
    trainable, _ = prepared(densifier, 0)
    for tensor in trainable.values.tensors().values():
        tensor.grad = torch.ones_like(tensor)
    densifier.refine(600, trainable, generator(0))
    before = trainable.values.detach().map(torch.clone)
    trainable.optimizer_step()
    assert torch.equal(before.means, trainable.values.means)
    trainable.values.means.grad = torch.ones_like(trainable.values.means)
    trainable.optimizer_step()
    assert not torch.equal(before.means, trainable.values.means)
    assert float(trainable.adam["means"].step) == 3


def test_adc_refines_and_resets_at_the_iterations_of_3dgs():
    """144 refinements from 600 to 14,900, and resets at 3000, 6000, 9000 and 12,000."""
    densifier = ADC()
    gaussians = random_gaussians(4)
    trainable = trained(gaussians)
    densifier.begin(gaussians, DensifyContext(EXTENT))
    due, resets = [], []
    densifier.grow_by_gradient = lambda refinement: due.append(refinement.step)
    for step in range(1, 30_001):
        event = densifier.refine(step, trainable, generator())
        if event is not None and event.opacity_reset:
            resets.append(step)
    assert due == list(range(600, 15_000, 100))
    assert resets == [3000, 6000, 9000, 12_000]


def test_default_windows_agree_with_the_options_of_training():
    window = TrainConfig.densify_start, TrainConfig.densify_stop, TrainConfig.densify_interval
    assert (ADC.start, ADC.stop, ADC.interval) == window == (500, 15_000, 100)
    assert (MCMC.start, MCMC.stop, MCMC.interval) == (500, TrainConfig.mcmc_stop, 100)
    assert (MRNF.start, MRNF.stop, MRNF.interval) == (0, 25_000, 200)
    assert ADC.opacity_reset_interval == TrainConfig.opacity_reset_interval == 3000


@pytest.mark.parametrize("white, resets", [(False, [3000, 6000]), (True, [500, 3000, 6000])])
def test_with_a_white_background_opacities_are_also_reset_at_the_start(white, resets):
    densifier = ADC(stop=9000)
    trainable, _ = prepared(densifier, 0, count=3)
    densifier.context = DensifyContext(EXTENT, white_background=white)
    found = []
    for step in (499, 500, 501, 3000, 4500, 6000, 9000):
        refinement = at(step, trainable)
        found += [step] if densifier.reset_opacity in densifier.rules(refinement) else []
    assert found == resets


def test_adc_gathers_gradients_and_radii_until_the_window_ends():
    densifier = ADC(stop=800)
    densifier.begin(random_gaussians(3), DensifyContext(EXTENT))
    shown = [(1, [4, 0, 2]), (799, [3, 5, 2]), (800, [9, 9, 9])]  # the last is after the window
    for step, radii in shown:
        densifier.observe(step, rendered([[3.0, 4.0]] * 3, radii))
    assert densifier.statistics["max_radii"].tolist() == [4, 5, 2]
    assert densifier.statistics["visible_count"].tolist() == [2, 1, 2]
    assert densifier.statistics["gradient_sum"].tolist() == [10.0, 5.0, 10.0]
    assert densifier.mean_gradient().tolist() == [5.0] * 3


def test_huge_gaussians_are_pruned_by_size_or_radius_after_the_first_reset():
    densifier = ADC(prune_screen_radius=20.0)
    densifier.begin(random_gaussians(4), DensifyContext(EXTENT))
    densifier.statistics["max_radii"] = torch.tensor([0, 20, 21, 0], dtype=torch.int32)
    log_scales = torch.tensor([[-9.0, -9.0, 0.39], [-9.0] * 3, [-9.0] * 3, [-9.0, 0.41, -9.0]])
    # of 0.1 times the extent of 4: just below and above
    log_scales[[0, 3], [2, 1]] = log_scales[[0, 3], [2, 1]].log()
    assert densifier.huge(3000, log_scales).tolist() == [False] * 4
    assert densifier.huge(3001, log_scales).tolist() == [False, False, True, True]
