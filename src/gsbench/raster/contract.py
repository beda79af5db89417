"""A test of the contract of ``raster.base``: it compares a rasterizer with the float64 reference on seeded scenes.

gsbench tests its own executors with the same scenes. To test yours:

    assert departures(MyRasterizer()) == []
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsbench.gaussians.model import Gaussians
from gsbench.raster.base import Rasterizer, RenderOutput
from gsbench.raster.executors import offers
from gsbench.raster.reference import ReferenceRasterizer
from gsbench.scene.types import Camera

VALUE_TOLERANCE = 1e-4  # of image and alpha
GRADIENT_TOLERANCE = 1e-3  # of the largest entry of each gradient
FOOTPRINT_TOLERANCE = 1e-3  # of each sum: rounding may skip a pixel whose alpha is nearly 1/255, or not


@dataclass(frozen=True)
class Case:
    """A seeded scene with its camera. ``principal`` is the offset of the principal point from the image centre, px."""

    width: int
    height: int
    count: int
    sh_degree: int
    principal: tuple[float, float] = (0.0, 0.0)
    log_scale: float = -2.0
    logit: float = 0.0

    def __str__(self) -> str:
        return f"{self.width}x{self.height}-n{self.count}-sh{self.sh_degree}"

    def camera(self) -> Camera:
        angle = 0.2
        rotation = np.array(
            [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]], dtype=np.float64
        )
        return Camera(
            self.width,
            self.height,
            1.1 * self.width,
            1.05 * self.width,
            self.width / 2 + self.principal[0],
            self.height / 2 + self.principal[1],
            rotation,
            np.array([0.1, -0.2, 0.3]),
        )

    def gaussians(self) -> Gaussians:
        """float64 values that are exact in float32; some Gaussians are behind the camera or outside the image."""
        generator = torch.Generator().manual_seed(self.width * 1000 + self.count)

        def normal(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=generator, dtype=torch.float64)

        means = normal(self.count, 3)
        means[:, 2] += 4
        gaussians = Gaussians(
            means,
            self.log_scale + 0.8 * normal(self.count, 3),
            normal(self.count, 4),
            self.logit + 2 * normal(self.count),
            0.7 * normal(self.count, 3),
            0.2 * normal(self.count, 15, 3),
        )
        return gaussians.map(lambda tensor: tensor.float().double())


CASES = (
    Case(33, 49, 50, sh_degree=3),  # the last tiles are one pixel wide and one pixel high
    Case(97, 65, 250, sh_degree=3, principal=(7.3, -5.1)),
    Case(64, 48, 150, sh_degree=2, log_scale=-3.0),
    Case(50, 37, 120, sh_degree=1, log_scale=-1.0),
    Case(81, 50, 150, sh_degree=0, log_scale=-2.5, principal=(-20.0, 11.0)),
    Case(40, 40, 300, sh_degree=3, log_scale=-1.5, logit=3.0),  # opaque: pixels stop early, alphas are clamped
    Case(7, 5, 20, sh_degree=3),  # smaller than a tile
)


def render_with_gradients(
    rasterizer: Rasterizer, case: Case, dtype: torch.dtype, device: str = "cpu"
) -> tuple[RenderOutput, dict[str, Tensor]]:
    """Render ``case``; also return gradients, as float64 on the CPU, of a fixed random weighting of image and alpha.

    Includes the splitting matrices if the rasterizer offers them.
    """
    gaussians = case.gaussians().map(lambda tensor: tensor.to(device, dtype).requires_grad_())
    background = torch.tensor([0.2, 0.5, 0.9], dtype=dtype, device=device)
    extra = {"splitting_matrix": True} if offers(rasterizer.name, "has_splitting_matrix", rasterizer) else {}
    output = rasterizer.render(gaussians, case.camera(), case.sh_degree, background, absolute_gradient=True, **extra)
    generator = torch.Generator().manual_seed(7)
    weights = torch.randn(case.height, case.width, 4, generator=generator, dtype=torch.float64).to(device, dtype)
    ((output.image * weights[..., :3]).sum() + (output.alpha * weights[..., 3]).sum()).backward()
    gradients = {name: tensor.grad for name, tensor in gaussians.tensors().items()}
    gradients |= {"screen_points": output.screen_points.grad, "screen_gradient_abs": output.screen_gradient_abs}
    if extra:
        gradients["splitting_probe"] = output.require_splitting_matrix()
    return output, {
        name: torch.zeros(()) if gradient is None else gradient.detach().cpu().double()
        for name, gradient in gradients.items()
    }


def departures(rasterizer: Rasterizer, device: str = "cpu", cases: tuple[Case, ...] = CASES) -> list[str]:
    """List where ``rasterizer``, in float32 on ``device``, departs from the contract, one line each; [] if nowhere.

    For all ``cases``, it compares image, alpha, radii, all gradients and, if offered, footprint and splitting matrices
    with the reference. It also tests a scene without Gaussians. Takes seconds.
    """
    return [line for case in cases for line in _compare(rasterizer, case, device)] + _without_gaussians(
        rasterizer, device
    )


def _compare(rasterizer: Rasterizer, case: Case, device: str) -> list[str]:
    expected, references = render_with_gradients(ReferenceRasterizer(), case, torch.float64)
    try:
        output, gradients = render_with_gradients(rasterizer, case, torch.float32, device)
    except (RuntimeError, ValueError, TypeError, NotImplementedError) as error:
        return [f"{case}: {type(error).__name__}: {error}"]
    lines = []
    for name in ("image", "alpha"):
        value, reference = getattr(output, name).detach().cpu().double(), getattr(expected, name).detach()
        if value.shape != reference.shape:
            lines.append(f"{case}: {name} has shape {tuple(value.shape)}, expected {tuple(reference.shape)}")
        elif not (off := _largest(value - reference)) < VALUE_TOLERANCE:
            lines.append(f"{case}: {name} is off by up to {off:.2e}")
    if output.radii.dtype != torch.int32:
        lines.append(f"{case}: radii are {output.radii.dtype}, expected torch.int32")
    elif not torch.equal(output.radii.cpu(), expected.radii):
        different = int((output.radii.cpu() != expected.radii).sum())
        lines.append(f"{case}: radii differ for {different} of {case.count} Gaussians")
    for name, reference in references.items():
        if name == "splitting_probe" and name not in gradients:
            continue  # optional
        if reference.dim() == 0:  # no gradient: at degree 0 nothing depends on ``sh_rest``
            reference = torch.zeros_like(gradients[name])
        if gradients[name].shape != reference.shape:
            lines.append(f"{case}: there is no gradient of {name}")
            continue
        off = _largest(gradients[name] - reference) / max(_largest(reference), 1e-30)
        if not off < GRADIENT_TOLERANCE:
            lines.append(f"{case}: the gradient of {name} is off by {off:.2e} of its largest entry")
    if output.footprint is not None:
        for name, off in footprint_errors(output, expected).items():
            if not off < FOOTPRINT_TOLERANCE:
                lines.append(f"{case}: the {name} of the footprint are off by {off:.2e} of their sum")
    return lines


def footprint_errors(output: RenderOutput, expected: RenderOutput) -> dict[str, float]:
    """The error of each field of ``output``'s footprint against ``expected``, relative to the field's sum."""
    height, width = expected.alpha.shape
    values = torch.rand(height, width, generator=torch.Generator().manual_seed(8), dtype=torch.float64)
    assert output.footprint is not None
    assert expected.footprint is not None
    footprint, reference = output.footprint(values.to(output.alpha)), expected.footprint(values)
    errors = {}
    for name, correct in vars(reference).items():
        error = (getattr(footprint, name).cpu().double() - correct).abs().sum()
        errors[name] = float(error / correct.abs().sum().double().clamp_min(1e-30))
    return errors


def _without_gaussians(rasterizer: Rasterizer, device: str) -> list[str]:
    case = CASES[0]
    empty = case.gaussians().map(lambda tensor: tensor[:0].to(device, torch.float32).requires_grad_())
    background = torch.tensor([0.1, 0.2, 0.3], device=device)
    try:
        output = rasterizer.render(empty, case.camera(), case.sh_degree, background)
        output.image.sum().backward()
    except (RuntimeError, ValueError, TypeError, IndexError, ZeroDivisionError) as error:
        return [f"without Gaussians: {type(error).__name__}: {error}"]
    if not torch.equal(output.image, background.expand(case.height, case.width, 3)) or output.alpha.abs().max() > 0:
        return ["without Gaussians: the image is not the background"]
    return []


def _largest(tensor: Tensor) -> float:
    """The largest absolute value, NaN included; 0 for an empty tensor."""
    return float(tensor.abs().max()) if tensor.numel() else 0.0
