"""Whole refinement rounds against the slow restatement.

The same Gaussians, optimiser moments and events.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsbench.densify import ADC, MCMC, MRNF, Densifier, DensifyContext, Refinement, Volumetric
from gsbench.gaussians.model import Gaussians
from gsbench.gaussians.paper_values import LearningRates
from gsbench.gaussians.trainable import TrainableGaussians
from gsbench.raster.base import RenderOutput
from gsbench.train.options import TrainConfig
from tests.densify import restatement
from tests.gaussians.helpers import random_gaussians

EXTENT = 4.0


def prepared(
    densifier: Densifier, seed: int, count: int = 60
) -> tuple[TrainableGaussians, np.ndarray]:
    """Gaussians with uneven Adam moments, and three observed iterations.

    Also the mean gradient of each.
    """
    rng = np.random.default_rng(seed)
    gaussians = random_gaussians(count, seed, log_scale=(-6.0, 0.3))
    gaussians.opacity_logits.copy_(torch.from_numpy(rng.uniform(-8, 3, count)))
    trainable = TrainableGaussians(gaussians, LearningRates(), EXTENT)
    for _ in range(2):
        for tensor in trainable.values.tensors().values():
            tensor.grad = torch.from_numpy(rng.normal(size=tensor.shape) * 1e-3)
        trainable.optimizer_step()
    densifier.begin(trainable.values.detach(), DensifyContext(EXTENT))
    total, seen = np.zeros(count), np.zeros(count)
    for step in range(1, 4):
        gradient, radii = observe(densifier, trainable, rng, step)
        for i in range(count):
            if radii[i] > 0:
                total[i] += np.hypot(*gradient[i])
                seen[i] += 1
    return trainable, np.divide(total, seen, out=np.zeros(count), where=seen > 0)


def observe(
    densifier: Densifier, trainable: TrainableGaussians, rng: np.random.Generator, step: int
) -> tuple[np.ndarray, np.ndarray]:
    """Show the densifier a made-up render.

    Returns the gradients [N, 2] and radii [N] of the points in it.
    """
    count = len(trainable)
    points = torch.zeros(count, 2, dtype=torch.float64, requires_grad=True)
    points.grad = torch.from_numpy(rng.exponential(2e-4, (count, 2)))
    radii = torch.from_numpy(rng.integers(0, 3, count).astype(np.int32))
    probe = torch.zeros(count, 3, 3, dtype=torch.float64, requires_grad=True)
    probe.grad = torch.zeros_like(probe)
    empty = torch.empty(0)
    densifier.observe(
        step, RenderOutput(empty, empty, radii, points, points.grad, splitting_probe=probe)
    )
    return points.grad.numpy(), radii.numpy()


def to_rows(trainable: TrainableGaussians) -> list[restatement.Row]:
    tensors = trainable.values.tensors()
    rows = []
    for i in range(len(trainable)):
        row = {name: tensor[i].detach().numpy().copy() for name, tensor in tensors.items()}
        row |= {
            "first " + name: state.first[i].numpy().copy() for name, state in trainable.adam.items()
        }
        row |= {
            "second " + name: state.second[i].numpy().copy()
            for name, state in trainable.adam.items()
        }
        rows.append(row)
    return rows


def noise_of(seed: int, counts: list[int]) -> list[np.ndarray]:
    """The normal draws of the real code: one batch of [2 S, 3] per rule that splits S parents."""
    rng = torch.Generator().manual_seed(seed)
    return [
        row
        for s in counts
        for row in torch.randn(2 * s, 3, generator=rng, dtype=torch.float64).numpy()
    ]


def assert_same(trainable: TrainableGaussians, rows: list[restatement.Row]) -> None:
    found = to_rows(trainable)
    assert len(found) == len(rows)
    for real, expected in zip(found, rows, strict=True):
        assert real.keys() == expected.keys()
        for name in real:
            np.testing.assert_allclose(
                real[name], expected[name], rtol=1e-5, atol=1e-7, err_msg=name
            )
            apart = np.abs(real[name] - expected[name]) / np.maximum(1, np.abs(expected[name]))
            restatement.DIFFERENCES.append(float(apart.max(initial=0)))


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("step", [600, 3100])
def test_adc_round(seed: int, step: int) -> None:
    densifier = ADC()
    trainable, gradient = prepared(densifier, seed)
    rows, expected = to_rows(trainable), {}
    event = densifier.refine(step, trainable, torch.Generator().manual_seed(seed))
    noise = iter(noise_of(seed, [event.split_gradient]))
    rows = restatement.adc_growth(rows, gradient, EXTENT, noise, expected)
    rows = restatement.prune(rows, step, EXTENT, expected)
    assert_same(trainable, rows)
    assert expected == {name: getattr(event, name) for name in expected}
    assert event.cloned > 0
    assert event.split_gradient > 0
    assert event.after == len(rows) == len(densifier.lineage.ids)


@pytest.mark.parametrize("seed", range(2))
def test_absgrad_round(seed: int) -> None:
    """As ADC, of another gradient at four times the threshold."""
    densifier = ADC(gradient="absolute", gradient_threshold=0.0008)
    trainable, gradient = prepared(densifier, seed)
    densifier.statistics["gradient_sum"] *= 4
    rows, expected = to_rows(trainable), {}
    event = densifier.refine(600, trainable, torch.Generator().manual_seed(seed))
    noise = iter(noise_of(seed, [event.split_gradient]))
    rows = restatement.prune(
        restatement.adc_growth(rows, gradient, EXTENT, noise, expected), 600, EXTENT, expected
    )
    assert_same(trainable, rows)
    assert expected == {name: getattr(event, name) for name in expected}


@pytest.mark.parametrize("seed", range(2))
def test_revised_round(seed: int) -> None:
    """As ADC, but clone, original and children of a split each have 1 - sqrt(1 - o)."""
    densifier = ADC(revised_opacity=True)
    trainable, gradient = prepared(densifier, seed)
    rows, expected = to_rows(trainable), {}
    event = densifier.refine(600, trainable, torch.Generator().manual_seed(seed))
    noise = iter(noise_of(seed, [event.split_gradient]))
    for i, row in enumerate(rows):
        if gradient[i] >= 0.0002:
            opacity = 1 - np.sqrt(1 - 1 / (1 + np.exp(-row["opacity_logits"])))
            row["opacity_logits"] = np.log(opacity / (1 - opacity))
            row["first opacity_logits"], row["second opacity_logits"] = np.zeros(()), np.zeros(())
    rows = restatement.prune(
        restatement.adc_growth(rows, gradient, EXTENT, noise, expected), 600, EXTENT, expected
    )
    assert_same(trainable, rows)
    assert expected == {name: getattr(event, name) for name in expected}


@pytest.mark.parametrize("seed", range(2))
def test_volumetric_once_round(seed: int) -> None:
    """Who would be over the threshold again is left alone."""
    densifier = Volumetric(volume_threshold=0.03, split_isotropic=False)
    trainable, gradient = prepared(densifier, seed, count=200)
    rows, expected = to_rows(trainable), {}
    event = densifier.refine(600, trainable, torch.Generator().manual_seed(seed))
    noise = iter(noise_of(seed, [event.split_gradient, event.split_volume]))
    rows = restatement.adc_growth(rows, gradient, EXTENT, noise, expected)
    chosen, scales = [], {}
    for i, row in enumerate(rows):
        s = np.exp(row["log_scales"])
        child = s / (s.max() / s.min())
        if 4 / 3 * np.pi * s.prod() > 0.03 >= 4 / 3 * np.pi * child.prod():
            chosen.append(i)
            scales[i] = np.log(child)
    rows = restatement.prune(
        restatement.split_all(rows, chosen, scales, noise), 600, EXTENT, expected
    )
    assert_same(trainable, rows)
    assert event.split_volume == len(chosen) > 0


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("step", [600, 3100])
def test_volumetric_round(seed: int, step: int) -> None:
    densifier = Volumetric(volume_threshold=0.03)
    trainable, gradient = prepared(densifier, seed)
    rows, expected = to_rows(trainable), {}
    event = densifier.refine(step, trainable, torch.Generator().manual_seed(seed))
    noise = iter(noise_of(seed, [event.split_gradient, event.split_volume]))
    rows = restatement.adc_growth(rows, gradient, EXTENT, noise, expected)
    rows = restatement.volume_growth(rows, 0.03, noise, expected)
    rows = restatement.prune(rows, step, EXTENT, expected)
    assert_same(trainable, rows)
    assert expected == {name: getattr(event, name) for name in expected}
    assert event.split_volume > 0


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("step", [600, 3100])
def test_volumes_may_be_split_before_the_gradient_rule(seed: int, step: int) -> None:
    densifier = Volumetric(volume_threshold=0.03, volume_order="before_adc")
    trainable, gradient = prepared(densifier, seed)
    rows, expected = to_rows(trainable), {}
    large = np.array([4 / 3 * np.pi * np.exp(row["log_scales"]).prod() > 0.03 for row in rows])
    event = densifier.refine(step, trainable, torch.Generator().manual_seed(seed))
    noise = iter(noise_of(seed, [event.split_volume, event.split_gradient]))
    rows = restatement.volume_growth(rows, 0.03, noise, expected)
    # nobody has seen the children yet
    gradient = np.concatenate([gradient[~large], np.zeros(2 * large.sum())])
    rows = restatement.adc_growth(rows, gradient, EXTENT, noise, expected)
    rows = restatement.prune(rows, step, EXTENT, expected)
    assert_same(trainable, rows)
    assert expected == {name: getattr(event, name) for name in expected}
    assert event.split_volume > 0
    assert event.split_gradient > 0


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("step", [600, 3100])
def test_volumes_may_be_split_after_pruning(seed: int, step: int) -> None:
    densifier = Volumetric(volume_threshold=0.003, volume_order="after_prune")
    trainable, gradient = prepared(densifier, seed)
    rows, expected = to_rows(trainable), {}
    event = densifier.refine(step, trainable, torch.Generator().manual_seed(seed))
    noise = iter(noise_of(seed, [event.split_gradient, event.split_volume]))
    rows = restatement.adc_growth(rows, gradient, EXTENT, noise, expected)
    rows = restatement.prune(rows, step, EXTENT, expected)
    rows = restatement.volume_growth(rows, 0.003, noise, expected)
    assert_same(trainable, rows)
    assert expected == {name: getattr(event, name) for name in expected}
    assert event.split_volume > 0
    assert event.pruned_opacity > 0


SWITCHES: dict[str, list[object]] = {
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
def test_any_combination_of_switches_goes_through_several_rounds(seed: int) -> None:
    """A pairwise-covering draw of the switches.

    Every round balances, stays finite and keeps to an exact cap.
    """
    rng = np.random.default_rng(seed)
    options = {name: values[rng.integers(len(values))] for name, values in SWITCHES.items()}
    if options["cap"] == "curve":
        options["max_gaussians"] = 90
    densifier = Volumetric(**options)  # type: ignore[arg-type]
    trainable, _ = prepared(densifier, seed)
    generator = torch.Generator().manual_seed(seed)
    for step in (2900, 3000, 3100, 3200):
        observe(densifier, trainable, rng, step)
        event = densifier.refine(step, trainable, generator)
        assert event is not None
        grown = event.cloned + event.split_gradient + event.split_volume
        assert event.after == event.before + grown - event.pruned_opacity - event.pruned_size
        assert (
            event.after
            == len(trainable)
            == len(densifier.lineage.ids)
            == len(densifier.statistics["gradient_sum"])
        )
        assert all(torch.isfinite(tensor).all() for tensor in trainable.values.tensors().values())
        if options["max_gaussians"] is not None and options["cap"] != "soft":
            assert len(trainable) <= 90


def test_every_event_balances() -> None:
    for seed in range(20):
        densifier = Volumetric(max_gaussians=80, cap="hard")
        trainable, _ = prepared(densifier, seed)
        event = densifier.refine(3100, trainable, torch.Generator().manual_seed(seed))
        grown = event.cloned + event.split_gradient + event.split_volume
        assert event.after == event.before + grown - event.pruned_opacity - event.pruned_size


def test_optimizer_step_is_skipped_after_a_refinement_and_goes_on_after_it() -> None:
    densifier = ADC()
    trainable, _ = prepared(densifier, 0)
    for tensor in trainable.values.tensors().values():
        tensor.grad = torch.ones_like(tensor)
    densifier.refine(600, trainable, torch.Generator().manual_seed(0))
    before = trainable.values.detach().map(torch.clone)
    trainable.optimizer_step()
    assert torch.equal(before.means, trainable.values.means)
    trainable.values.means.grad = torch.ones_like(trainable.values.means)
    trainable.optimizer_step()
    assert not torch.equal(before.means, trainable.values.means)
    assert float(trainable.adam["means"].step) == 3


def test_opacity_reset_zeroes_the_opacity_moments_only() -> None:
    densifier = ADC(start=5000, stop=20_000)
    trainable, _ = prepared(densifier, 1)
    before = trainable.values.detach().map(torch.clone)
    event = densifier.refine(3000, trainable, torch.Generator())
    assert event.opacity_reset
    torch.testing.assert_close(trainable.values.opacities, before.opacities.clamp_max(0.01))
    assert torch.equal(trainable.values.means, before.means)
    assert not trainable.adam["opacity_logits"].first.any()
    assert trainable.adam["means"].first.all()


def test_refinements_of_the_paper_schedule() -> None:
    """144 refinements at 600, 700 ...

    14,900 and resets at 3000, 6000, 9000, 12,000 (the baseline's own count).
    """
    densifier = ADC()
    gaussians = random_gaussians(4)
    gaussians = Gaussians(**gaussians.tensors())
    trainable = TrainableGaussians(gaussians, LearningRates(), EXTENT)
    densifier.begin(gaussians, DensifyContext(EXTENT))
    due, resets = [], []
    densifier.grow_by_gradient = lambda refinement: due.append(refinement.step)  # type: ignore[method-assign]
    for step in range(1, 30_001):
        event = densifier.refine(step, trainable, torch.Generator())
        if event is not None and event.opacity_reset:
            resets.append(step)
    assert due == list(range(600, 15_000, 100))
    assert len(due) == 144
    assert resets == [3000, 6000, 9000, 12_000]


def test_windows_are_those_of_a_training() -> None:
    window = TrainConfig.densify_start, TrainConfig.densify_stop, TrainConfig.densify_interval
    assert (ADC.start, ADC.stop, ADC.interval) == window == (500, 15_000, 100)
    assert (MCMC.start, MCMC.stop, MCMC.interval) == (500, TrainConfig.mcmc_stop, 100)
    assert (MRNF.start, MRNF.stop, MRNF.interval) == (0, 25_000, 200)
    assert ADC.opacity_reset_interval == TrainConfig.opacity_reset_interval == 3000


@pytest.mark.parametrize(("white", "resets"), [(False, [3000, 6000]), (True, [500, 3000, 6000])])
def test_before_a_white_background_opacities_are_reset_at_the_start_too(
    white: bool, resets: list[int]
) -> None:
    densifier = ADC(stop=9000)
    trainable, _ = prepared(densifier, 0, count=3)
    densifier.context = DensifyContext(EXTENT, white_background=white)
    found = []
    for step in (499, 500, 501, 3000, 4500, 6000, 9000):
        refinement = Refinement(step, trainable, torch.Generator(), event=None)  # type: ignore[arg-type]
        found += [step] if densifier.reset_opacity in densifier.rules(refinement) else []
    assert found == resets


def test_gradients_and_radii_are_gathered_until_the_window_ends() -> None:
    densifier = ADC(stop=800)
    densifier.begin(random_gaussians(3), DensifyContext(EXTENT))
    shown = [(1, [4, 0, 2]), (799, [3, 5, 2]), (800, [9, 9, 9])]  # the last is after the window
    for step, radii in shown:
        points = torch.zeros(3, 2, dtype=torch.float64, requires_grad=True)
        points.grad = torch.tensor([[3.0, 4.0]] * 3, dtype=torch.float64)
        densifier.observe(
            step, RenderOutput(torch.empty(0), torch.empty(0), torch.tensor(radii).int(), points)
        )
    assert densifier.statistics["max_radii"].tolist() == [4, 5, 2]
    assert densifier.statistics["visible_count"].tolist() == [2, 1, 2]
    assert densifier.statistics["gradient_sum"].tolist() == [10.0, 5.0, 10.0]
    assert densifier.mean_gradient().tolist() == [5.0] * 3


def test_the_huge_are_pruned_after_the_first_reset_by_size_or_by_radius() -> None:
    densifier = ADC(prune_screen_radius=20.0)
    densifier.begin(random_gaussians(4), DensifyContext(EXTENT))
    densifier.statistics["max_radii"] = torch.tensor([0, 20, 21, 0], dtype=torch.int32)
    log_scales = torch.tensor([[-9.0, -9.0, 0.39], [-9.0] * 3, [-9.0] * 3, [-9.0, 0.41, -9.0]])
    # of 0.1 times the extent of 4: just below and above
    log_scales[[0, 3], [2, 1]] = log_scales[[0, 3], [2, 1]].log()
    assert densifier.huge(3000, log_scales).tolist() == [False] * 4
    assert densifier.huge(3001, log_scales).tolist() == [False, False, True, True]
