"""A test of the contract of ``raster.base``.

It compares a rasterizer with the float64 reference on seeded scenes. gsbench tests its own
executors with the same scenes. To test yours:

    assert departures(MyRasterizer()) == []
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gsbench.gaussians.model import Gaussians
from gsbench.raster.base import Rasterizer, RenderOutput
from gsbench.raster.reference import ReferenceRasterizer
from gsbench.scene.types import Camera

VALUE_TOLERANCE = 1e-4  # of image and alpha
RADIUS_TOLERANCE = 0.5  # px: radii are whole
GRADIENT_TOLERANCE = 1e-3  # of the largest entry of each gradient
# of each sum: rounding may skip a pixel whose alpha is nearly 1/255, or not
FOOTPRINT_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Case:
    """A seeded scene with its camera.

    ``principal`` is the offset of the principal point from the image centre, px. ``spread`` scales
    the distances of the Gaussians from the axis through their middle, which is ``depth`` away.
    """

    width: int
    height: int
    count: int
    sh_degree: int
    principal: tuple[float, float] = (0.0, 0.0)
    log_scale: float = -2.0
    logit: float = 0.0
    spread: float = 1.0
    depth: float = 4.0

    def __str__(self) -> str:
        return f"{self.width}x{self.height}-n{self.count}-sh{self.sh_degree}"

    def camera(self) -> Camera:
        angle = 0.2
        rotation = np.array(
            [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]],
            dtype=np.float64,
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
        """float64 values that are exact in float32.

        Some Gaussians are behind the camera or outside the image.
        """
        generator = torch.Generator().manual_seed(self.width * 1000 + self.count)

        def normal(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=generator, dtype=torch.float64)

        means = normal(self.count, 3)
        means[:, :2] *= self.spread
        means[:, 2] += self.depth
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
    # opaque: pixels stop early, alphas are clamped
    Case(40, 40, 300, sh_degree=3, log_scale=-1.5, logit=3.0),
    Case(7, 5, 20, sh_degree=3),  # smaller than a tile
)


def render_with_gradients(
    rasterizer: Rasterizer, case: Case, dtype: torch.dtype, device: str = "cpu"
) -> tuple[RenderOutput, dict[str, Tensor]]:
    """Render ``case``; return the output and the gradients, as float64 on the CPU.

    The loss is a sum of image and alpha with fixed random weights. An extra output that the
    rasterizer and the reference have in common is among the gradients, under its name.
    """
    gaussians = case.gaussians().map(lambda tensor: tensor.to(device, dtype).requires_grad_())
    background = torch.tensor([0.2, 0.5, 0.9], dtype=dtype, device=device)
    offered = getattr(rasterizer, "extras", {})
    common = next((name for name in ReferenceRasterizer.extras if name in offered), None)
    extra = {} if common is None else {"extra": common}
    output = rasterizer.render(
        gaussians, case.camera(), case.sh_degree, background, absolute_gradient=True, **extra
    )
    generator = torch.Generator().manual_seed(7)
    weights = torch.randn(case.height, case.width, 4, generator=generator, dtype=torch.float64)
    weights = weights.to(device, dtype)
    ((output.image * weights[..., :3]).sum() + (output.alpha * weights[..., 3]).sum()).backward()
    gradients = {name: tensor.grad for name, tensor in gaussians.tensors().items()}
    gradients |= {
        "screen_points": output.screen_points.grad,
        "screen_gradient_abs": output.screen_gradient_abs,
    }
    if common is not None:
        gradients[common] = output.require_extra()
    return output, {
        name: torch.zeros(()) if gradient is None else gradient.detach().cpu().double()
        for name, gradient in gradients.items()
    }


class Error(NamedTuple):
    """The largest error of a quantity in a case, its limit, and its place in words."""

    case: str
    quantity: str
    off: float  # NaN if a value is not finite
    limit: float
    place: str
    unit: str = ""

    @property
    def is_departure(self) -> bool:
        return not self.off < self.limit

    def __str__(self) -> str:
        if math.isinf(self.off):
            return f"{self.case}: {self.quantity} {self.place}"
        return (
            f"{self.case}: {self.quantity} is off by up to {self.off:.2e}{self.unit} at "
            f"{self.place}"
        )


def departures(
    rasterizer: Rasterizer, device: str = "cpu", cases: tuple[Case, ...] = CASES
) -> list[str]:
    """List where ``rasterizer``, in float32 on ``device``, departs from the contract.

    Returns one line for each departure; [] if there is none. For all ``cases``, image, alpha,
    radii, all gradients and, if offered, footprint and extra output are compared with the
    reference. A scene without Gaussians is tested, too. Takes seconds.
    """
    lines = []
    for case in cases:
        try:
            errors = measure(rasterizer, case, device)
            lines += [str(error) for error in errors if error.is_departure]
        except (RuntimeError, ValueError, TypeError, NotImplementedError) as error:
            lines.append(f"{case}: {type(error).__name__}: {error}")
    return lines + _without_gaussians(rasterizer, device)


def measure(rasterizer: Rasterizer, case: Case, device: str) -> list[Error]:
    """The largest error of each quantity of ``rasterizer`` against the float64 reference.

    ``rasterizer`` runs in float32 on ``device``. A wrong shape or dtype is an infinite error.
    """
    expected, references = render_with_gradients(ReferenceRasterizer(), case, torch.float64)
    output, gradients = render_with_gradients(rasterizer, case, torch.float32, device)
    errors = [
        _compare(case, "image", output.image, expected.image, VALUE_TOLERANCE, pixel_size=3),
        _compare(case, "alpha", output.alpha, expected.alpha, VALUE_TOLERANCE, pixel_size=1),
        _compare(case, "radius", output.radii, expected.radii, RADIUS_TOLERANCE),
    ]
    if output.radii.dtype != torch.int32:
        found = f"is {output.radii.dtype}, expected torch.int32"
        errors.append(Error(str(case), "radius", math.inf, RADIUS_TOLERANCE, found))
    for name, reference in references.items():
        is_extra = name in ReferenceRasterizer.extras
        if is_extra and name not in gradients:
            continue  # optional
        if reference.dim() == 0:  # no gradient: at degree 0 nothing depends on ``sh_rest``
            reference = torch.zeros_like(gradients[name])
        quantity = name if is_extra else f"gradient of {name}"
        errors.append(
            _compare(case, quantity, gradients[name], reference, GRADIENT_TOLERANCE, True)
        )
    if output.footprint is not None:
        for name, off in footprint_errors(output, expected).items():
            field = f"footprint ({name})"
            limit = FOOTPRINT_TOLERANCE
            errors.append(Error(str(case), field, off, limit, "all pixels", " of the sum"))
    return errors


def _compare(
    case: Case,
    quantity: str,
    value: Tensor,
    reference: Tensor,
    limit: float,
    relative: bool = False,
    pixel_size: int = 0,
) -> Error:
    """The largest error of a tensor, divided by the largest entry if ``relative``.

    An image has ``pixel_size`` numbers for each pixel; other tensors have one row per Gaussian.
    """
    value, reference = value.detach().cpu().double(), reference.detach().double()
    if value.shape != reference.shape:
        shapes = f"has shape {tuple(value.shape)}, expected {tuple(reference.shape)}"
        found = shapes if value.dim() else "is missing"
        return Error(str(case), quantity, math.inf, limit, found)
    unit = " of its largest entry" if relative else ""
    off = (value - reference).abs()
    if not off.numel():
        return Error(str(case), quantity, 0.0, limit, "nothing", unit)
    index = int(off.argmax())
    if pixel_size:
        row, column = divmod(index // pixel_size, case.width)
        place = f"pixel ({column}, {row})"
    else:
        numbers = off.numel() // max(1, case.count) or 1  # of each Gaussian; 1 without a gradient
        place = f"Gaussian {index // numbers}"
    scale = max(float(reference.abs().max()), 1e-30) if relative else 1.0
    return Error(str(case), quantity, float(off.max()) / scale, limit, place, unit)


def footprint_errors(output: RenderOutput, expected: RenderOutput) -> dict[str, float]:
    """The error of each field of ``output``'s footprint, relative to the field's sum."""
    height, width = expected.alpha.shape
    generator = torch.Generator().manual_seed(8)
    values = torch.rand(height, width, generator=generator, dtype=torch.float64)
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
    empty = case.gaussians().map(
        lambda tensor: tensor[:0].to(device, torch.float32).requires_grad_()
    )
    background = torch.tensor([0.1, 0.2, 0.3], device=device)
    try:
        output = rasterizer.render(empty, case.camera(), case.sh_degree, background)
        output.image.sum().backward()
    except (RuntimeError, ValueError, TypeError, IndexError, ZeroDivisionError) as error:
        return [f"without Gaussians: {type(error).__name__}: {error}"]
    is_background = torch.equal(output.image, background.expand(case.height, case.width, 3))
    if is_background and output.alpha.abs().max() == 0:
        return []
    return ["without Gaussians: the image is not the background"]
