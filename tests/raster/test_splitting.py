"""Splitting matrices against second derivatives by autograd."""

import pytest
import torch
from torch.autograd.functional import hessian, jacobian
from torch.testing import assert_close

from gsbench.raster import create_rasterizer
from gsbench.raster.base import CONSTANTS
from gsbench.raster.contract import Case
from gsbench.raster.reference import project, tile_rectangles
from tests.densify.helpers import generator
from tests.gaussians.helpers import leaves

CASES = (
    Case(7, 5, 20, sh_degree=0),
    Case(33, 20, 40, sh_degree=0, log_scale=-1.5, principal=(4.0, -3.0)),
    # opaque: alphas are clamped, pixels stop early
    Case(12, 16, 60, sh_degree=0, log_scale=-1.0, logit=3.0),
)


def image_of(camera, mean):
    """Project a point [3] to the image, [2] px."""
    x, y, z = mean.new_tensor(camera.rotation) @ mean + mean.new_tensor(camera.translation)
    return torch.stack([camera.fx * x / z + camera.cx - 0.5, camera.fy * y / z + camera.cy - 0.5])


def heights(pixels, mean, conic, opacity):
    """Opacity times density of one Gaussian at pixels [P, 2]."""
    d = pixels - mean
    return opacity * torch.exp(
        -0.5
        * (conic[0] * d[:, 0] ** 2 + 2 * conic[1] * d[:, 0] * d[:, 1] + conic[2] * d[:, 1] ** 2)
    )


class Slow:
    """A case composited pixel by pixel from the heights of its Gaussians.

    A height is opacity times density at a pixel. The loss weights the image with fixed numbers.
    """

    def __init__(self, case):
        self.case, self.camera, self.gaussians = case, case.camera(), case.gaussians()
        self.projected = project(self.gaussians, self.camera)
        rows, columns = torch.meshgrid(
            torch.arange(case.height), torch.arange(case.width), indexing="ij"
        )
        self.pixels = torch.stack([columns, rows], -1).reshape(-1, 2).double()
        self.colours = (
            self.gaussians.sh_dc[self.projected.index] * 0.28209479177387814 + 0.5
        ).clamp_min(0)
        self.order = torch.sort(self.projected.depths, stable=True).indices.tolist()
        self.weights = torch.randn(case.height, case.width, 3, generator=generator(3)).double()
        self.background = torch.tensor([0.3, 0.1, 0.8], dtype=torch.float64)

        self.means = self.gaussians.means[self.projected.index]
        # each [2, 3]
        self.linear = [
            jacobian(lambda point: image_of(self.camera, point), mean) for mean in self.means
        ]
        first, past = tile_rectangles(self.projected, self.camera)  # [M, 2]
        tiles = (self.pixels // CONSTANTS.tile).unsqueeze(0)  # [1, P, 2]
        self.reached = ((tiles >= first.unsqueeze(1)) & (tiles < past.unsqueeze(1))).all(
            -1
        )  # [M, P] pixels in the tiles of each Gaussian

    def height(self, k, displacement):
        """Heights [P] of the k-th projected Gaussian, moved by ``displacement`` [3].

        The movement on the image is linearised.
        """
        moved = self.projected.means[k] + self.linear[k] @ displacement
        opacity = self.gaussians.opacities[self.projected.index[k]]
        return heights(self.pixels, moved, self.projected.conics[k], opacity)

    def all_heights(self):
        rest = torch.zeros(3).double()
        return torch.stack([self.height(k, rest) for k in range(len(self.projected.index))])

    def loss(self, s):
        """The loss as a function of the heights [M, P]; the clamp to 0.99 passes the gradient."""
        colour = torch.zeros(len(self.pixels), 3).double()
        through = torch.ones(len(self.pixels)).double()
        alive = torch.ones(len(self.pixels), dtype=torch.bool)
        for k in self.order:
            alpha = s[k] + (s[k].detach().clamp_max(CONSTANTS.alpha_max) - s[k].detach())
            alpha = torch.where(alive & self.reached[k] & (s[k] >= CONSTANTS.alpha_min), alpha, 0.0)
            stop = through * (1 - alpha) < CONSTANTS.transmittance_min
            alive = alive & ~stop
            alpha = torch.where(stop, 0.0, alpha)
            colour = colour + (through * alpha).unsqueeze(-1) * self.colours[k]
            through = through * (1 - alpha)
        image = colour + through.unsqueeze(-1) * self.background
        return (image * self.weights.reshape(-1, 3)).sum()

    def matrices(self, rasterizer):
        """The splitting matrices that the rasterizer computes, [N, 3, 3] float64."""
        dtype = torch.float64 if rasterizer == "reference" else torch.float32
        executor = create_rasterizer(rasterizer, torch.device("cpu"), threads=1)
        inputs = leaves(self.gaussians, dtype), self.camera, 0, self.background.to(dtype)
        output = executor.render(*inputs, extra="splitting_matrix")
        (output.image * self.weights.to(dtype)).sum().backward()
        return output.require_extra().double()


@pytest.mark.parametrize("case", CASES, ids=str)
def test_the_matrix_is_the_gradient_by_heights_times_their_hessians(case):
    """The paper's definition, computed for one Gaussian at a time with autograd."""
    slow = Slow(case)
    s = slow.all_heights().detach().requires_grad_()
    (gradient,) = torch.autograd.grad(slow.loss(s), s)
    expected = torch.zeros(case.count, 3, 3).double()
    for k, index in enumerate(slow.projected.index.tolist()):
        used = s[k].detach() >= CONSTANTS.alpha_min

        def weighted(displacement, k=k, used=used):
            return (gradient[k] * slow.height(k, displacement))[used].sum()

        expected[index] = hessian(weighted, torch.zeros(3).double())
    assert (expected.abs().amax((1, 2)) > 0).sum() > case.count / 4
    exact = slow.matrices("reference")
    assert_close(exact, expected, rtol=1e-9, atol=1e-9 * float(expected.abs().max()))
    compiled = slow.matrices("cpu")
    sizes = expected.abs().amax((1, 2), keepdim=True)
    # errors are relative to each Gaussian's own matrix
    assert ((compiled - expected).abs() <= 1e-3 * sizes + 1e-6 * expected.abs().max()).all()


@pytest.mark.parametrize("name", ["reference", "cpu"])
def test_an_extra_output_is_given_only_on_request_and_by_its_name(name):
    case, executor = CASES[0], create_rasterizer(name, torch.device("cpu"), threads=1)
    inputs = case.gaussians().map(torch.Tensor.float), case.camera(), 0, torch.zeros(3)
    plain = executor.render(*inputs)
    assert plain.extra is None
    with pytest.raises(RuntimeError, match="extra=NAME, then backward"):
        plain.require_extra()
    with pytest.raises(ValueError, match=f"raster={name} gives splitting_matrix, not hessian"):
        executor.render(*inputs, extra="hessian")
