"""Tests of what gsbench's own executors promise beyond the contract, one function per promise."""

from collections import namedtuple

import pytest
import torch
from torch import Tensor

from gsbench.gaussians.model import Gaussians
from gsbench.raster.contract import Case, render_with_gradients
from gsbench.raster.reference import ReferenceRasterizer
from tests.gaussians.helpers import leaves as of_gaussians

BLACK = torch.zeros(3)


# An executor, scenes of two sizes that it renders quickly, and the largest error of a needle as a
# fraction of its largest gradient.
Subject = namedtuple("Subject", "make small large needle_limit")


def bits(output, gradients):
    tensors = [output.image, output.alpha, output.radii, *gradients.values()]
    return [tensor.detach().numpy().tobytes() for tensor in tensors]


def bits_of(rasterizer, case):
    return bits(*render_with_gradients(rasterizer, case, torch.float32))


def leaves(case):
    return of_gaussians(case.gaussians(), torch.float32)


def both(subject, gaussians, case, degree, name):
    """The gradients by the parameter ``name``: those of the executor, and those of the reference.

    The loss is the sum of the squared image.
    """
    found = []
    for rasterizer, dtype in (
        (subject.make(), torch.float32),
        (ReferenceRasterizer(), torch.float64),
    ):
        own = of_gaussians(gaussians, dtype)
        image = rasterizer.render(own, case.camera(), degree, BLACK.to(dtype)).image
        image.square().sum().backward()
        found.append(getattr(own, name).grad.double())
    return found


def equal_depths_are_blended_in_the_order_of_the_index(subject):
    gaussians = Gaussians(
        torch.tensor([[0.3, 0.2, 3.0]] * 5),
        torch.full((5, 3), -1.0),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 5),
        torch.ones(5),
        torch.eye(5)[:, :3] * 3,
        torch.zeros(5, 15, 3),
    )
    camera, precise = subject.large.camera(), gaussians.map(Tensor.double)
    image = subject.make().render(gaussians, camera, 0, BLACK).image
    reference = ReferenceRasterizer().render(precise, camera, 0, BLACK.double()).image
    assert (image - reference).abs().max() < 1e-5
    assert reference.max() > 0.5


def needles_keep_their_gradients(subject):
    """A needle is long and thin: computed as ac - b^2, its determinant loses all digits."""
    case = Case(50, 40, 20, sh_degree=0)
    gaussians = case.gaussians()
    gaussians.log_scales[:, 0] = 0.5
    gaussians.log_scales[:, 1:] = -9.0
    found, expected = both(subject, gaussians, case, 0, "log_scales")
    assert expected.abs().max() > 0
    assert (found - expected).abs().max() < subject.needle_limit * expected.abs().max()


def turning_a_ball_has_no_gradient(subject):
    """A sphere has no gradient, not even a rounding error, which Adam would scale to a full step.

    A Gaussian that is almost a sphere has one.
    """
    for stretch in (0.0, 0.01):
        gaussians = subject.large.gaussians()
        gaussians.log_scales[:] = gaussians.log_scales[:, :1]
        gaussians.log_scales[:, 1] += stretch
        found, expected = both(subject, gaussians, subject.large, 3, "quaternions")
        assert bool(found.any()) == (stretch > 0)
        assert (found - expected).abs().max() < 1e-3 * expected.abs().max() + 1e-12


def renders_may_be_differentiated_late_and_twice(subject):
    """Two graphs exist at once; the second is differentiated first, the first one twice."""
    rasterizer, cases = subject.make(), (subject.small, subject.large)
    alone = [render_with_gradients(rasterizer, case, torch.float32)[1]["means"] for case in cases]
    parameters = [leaves(case) for case in cases]
    background = torch.tensor([0.2, 0.5, 0.9])
    outputs = [
        rasterizer.render(own, case.camera(), 3, background)
        for own, case in zip(parameters, cases, strict=True)
    ]
    for k in (1, 0, 0):
        shape = (cases[k].height, cases[k].width, 4)
        generator = torch.Generator().manual_seed(7)
        weights = torch.randn(shape, generator=generator, dtype=torch.float64).float()
        parameters[k].means.grad = None
        image, alpha = outputs[k].image * weights[..., :3], outputs[k].alpha * weights[..., 3]
        (image.sum() + alpha.sum()).backward(retain_graph=True)
        assert torch.equal(parameters[k].means.grad.double(), alone[k])


def results_that_are_kept_are_not_overwritten(subject):
    rasterizer = subject.make()
    output, gradients = render_with_gradients(rasterizer, subject.small, torch.float32)
    kept = bits(output, gradients)
    image = output.image.detach()
    before = image.clone()
    render_with_gradients(rasterizer, subject.small, torch.float32)
    assert bits(output, gradients) == kept
    del output
    rasterizer.render(leaves(subject.large), subject.small.camera(), 0, BLACK)
    assert torch.equal(image, before)


def strided_parameters_are_taken_and_the_background_has_a_gradient(subject):
    gaussians = subject.small.gaussians().map(Tensor.float)
    strided = gaussians.map(lambda tensor: torch.stack([tensor, tensor], -1)[..., 0])
    assert not strided.means.is_contiguous()
    rasterizer, camera = subject.make(), subject.small.camera()
    background = torch.tensor([0.1, 0.5, 0.7], requires_grad=True)
    output = rasterizer.render(strided, camera, 3, background)
    assert torch.equal(output.image, rasterizer.render(gaussians, camera, 3, background).image)
    output.image.sum().backward()
    assert background.grad[0].item() == pytest.approx((1 - output.alpha).sum().item(), rel=1e-5)


def float64_is_refused(subject):
    case = subject.small
    with pytest.raises(ValueError, match="float32"):
        subject.make().render(case.gaussians(), case.camera(), 0, BLACK.double())


PROMISES = {
    function.__name__: function
    for function in (
        equal_depths_are_blended_in_the_order_of_the_index,
        needles_keep_their_gradients,
        turning_a_ball_has_no_gradient,
        renders_may_be_differentiated_late_and_twice,
        results_that_are_kept_are_not_overwritten,
        strided_parameters_are_taken_and_the_background_has_a_gradient,
        float64_is_refused,
    )
}
