"""Steps and edits of trainable Gaussians, compared with torch's own Adam."""

import pytest
import torch
from torch.testing import assert_close

from gsbench.gaussians.paper_values import LearningRates
from gsbench.gaussians.trainable import TrainableGaussians
from tests.gaussians.helpers import random_gaussians


def give_gradients(trainable, seed):
    rng = torch.Generator().manual_seed(seed)
    for tensor in trainable.values.tensors().values():
        tensor.grad = torch.randn(tensor.shape, generator=rng, dtype=tensor.dtype)


def step_with(trainable, seed, **arguments):
    give_gradients(trainable, seed)
    trainable.optimizer_step(**arguments)


def test_steps_equal_those_of_torchs_adam():
    """A parameter without a gradient does not change and counts no step."""
    ours = TrainableGaussians(random_gaussians(6), LearningRates(), 2.0)
    theirs = ours.values.map(lambda tensor: tensor.detach().clone().requires_grad_(True)).tensors()
    groups = [{"params": [tensor], "lr": ours.adam[name].rate} for name, tensor in theirs.items()]
    adam = torch.optim.Adam(groups, eps=1e-15)
    for seed in range(4):
        rng = torch.Generator().manual_seed(seed)
        for name, tensor in ours.values.tensors().items():
            if seed != 2 or name != "means":
                tensor.grad = torch.randn(tensor.shape, generator=rng, dtype=torch.float64)
            theirs[name].grad = None if tensor.grad is None else tensor.grad.clone()
        ours.optimizer_step()
        adam.step()
    assert_close(ours.values.tensors(), theirs, rtol=1e-12, atol=1e-15)


def test_a_step_with_all_gaussians_visible_equals_a_plain_step():
    whole = TrainableGaussians(random_gaussians(6), LearningRates(), 2.0)
    sparse = TrainableGaussians(random_gaussians(6), LearningRates(), 2.0)
    for seed in range(4):
        step_with(whole, seed)
        step_with(sparse, seed, visible=torch.ones(6, dtype=torch.bool))
    assert_close(whole.values.tensors(), sparse.values.tensors(), rtol=1e-9, atol=1e-12)


def test_a_step_of_visible_gaussians_does_not_change_the_others():
    trainable = TrainableGaussians(random_gaussians(6), LearningRates(), 2.0)
    before = trainable.values.detach().map(torch.clone)
    visible = torch.tensor([True, False, True, False, False, True])
    step_with(trainable, 0, visible=visible)
    assert torch.equal(trainable.values.means[~visible], before.means[~visible])
    assert not torch.isclose(trainable.values.means[visible], before.means[visible]).any()


def test_steps_at_degree_0_count_for_the_unused_harmonics():
    """Steps at degree 0, then at degree 3, equal Adam with zero gradients in the first steps."""
    quick = TrainableGaussians(random_gaussians(5), LearningRates(), 1.0)
    plain = TrainableGaussians(random_gaussians(5), LearningRates(), 1.0)
    for seed in range(3):
        step_with(quick, seed, sh_degree=0)
        give_gradients(plain, seed)
        plain.values.sh_rest.grad.zero_()
        plain.optimizer_step()
    step_with(quick, 9)
    step_with(plain, 9)
    assert_close(quick.values.tensors(), plain.values.tensors(), rtol=1e-9, atol=1e-12)


def test_values_of_another_shape_are_refused():
    trainable = TrainableGaussians(random_gaussians(5), LearningRates(), 3.0)
    with pytest.raises(ValueError, match=r"overwrite: opacity_logits has shape \(5,\), got \(4,\)"):
        trainable.overwrite("opacity_logits", torch.zeros(4, dtype=torch.float64))


def test_overwriting_clears_the_moments_of_the_chosen_gaussians():
    trainable = TrainableGaussians(random_gaussians(5), LearningRates(), 3.0)
    step_with(trainable, 0)
    means = trainable.adam["means"]
    before = means.second.clone()
    where = torch.tensor([True, False, False, True, False])
    values = torch.full((5, 3), 2.0, dtype=torch.float64)
    trainable.overwrite("means", values, where)
    assert torch.equal(trainable.values.means, values)
    assert trainable.values.means.requires_grad
    assert not means.second[where].any()
    assert torch.equal(means.second[~where], before[~where])
    assert means.first[~where].all()
    trainable.overwrite("means", values + 1)
    assert not means.first.any()
    assert not means.second.any()
    assert trainable.adam["sh_dc"].second.all()
    assert means.step == 1


def test_the_rate_of_the_means_falls_log_linearly():
    rates = LearningRates()
    wanted = {-10: 1.6e-4, 0: 1.6e-4, 15_000: 1.6e-5, 30_000: 1.6e-6, 60_000: 1.6e-6}
    assert {step: rates.position(step) for step in wanted} == pytest.approx(wanted)
    assert rates.sh_rest == pytest.approx(1.25e-4)
    trainable = TrainableGaussians(random_gaussians(2), rates, 3.0)
    assert trainable.position_rate == pytest.approx(4.8e-4)
    trainable.set_step(15_000)
    assert trainable.position_rate == pytest.approx(4.8e-5)
    trainable.set_rate("sh_dc", 0.5)
    assert trainable.adam["sh_dc"].rate == 0.5
