"""The contract of every rasterizer: inputs, outputs, and the constants of 3DGS.

Does not import torch.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

from gsbench.words import NamesAttributes

if TYPE_CHECKING:
    from collections.abc import Callable

    from torch import Tensor

    from gsbench.gaussians.model import Gaussians
    from gsbench.scene.types import Camera


@dataclass(frozen=True)
class RasterConstants:
    """Constants of the 2023 code of 3DGS (Kerbl et al.), in the order of the pipeline."""

    near: float = 0.2  # world units; a Gaussian whose centre has view z <= near is culled
    # the Jacobian's x/z, y/z are clamped to the image plus 0.3 tan(fov/2) on each side
    fov_margin: float = 0.3
    blur: float = 0.3  # px^2, added to the diagonal of the 2D covariance
    sigma_extent: float = 3.0  # radius = ceil(3 sqrt(lambda_max)) px
    eigenvalue_floor: float = 0.1  # inside the square root of lambda_max
    # px; a Gaussian reaches all pixels of the tiles that its square of side 2 radius touches
    tile: int = 16
    alpha_min: float = 1.0 / 255.0  # a smaller alpha is skipped
    alpha_max: float = 0.99  # a larger alpha is clamped to it (its gradient passes, as in 3DGS)
    # a pixel stops before the Gaussian that would lower it below this
    transmittance_min: float = 1e-4
    # Guards of gsbench's own, which change no result of 3DGS; beyond them float32 fails.
    max_radius: float = 2.0**24  # px; keeps the radius of a huge Gaussian within int32
    max_center: float = 1e9  # px; a Gaussian so far outside the image is culled
    max_variance: float = 1e18  # px^2; one with a larger variance is culled: squares stay finite
    # rounding must not lose a pixel of the contour alpha = 1/255:
    contour_margin: float = 0.01  # px, and relative, of the box around it
    pixel_margin: float = 0.02  # px, of a row of tiles
    log2_alpha_margin: float = 1e-3


CONSTANTS = RasterConstants()


def slope_limits(camera: Camera) -> tuple[float, float, float, float]:
    """The limits of the slopes in the Jacobian of the projection (`RasterConstants.fov_margin`).

    Returns the smallest and the largest x/z, then the smallest and the largest y/z.
    """
    margin_x = CONSTANTS.fov_margin * camera.width / (2 * camera.fx)
    margin_y = CONSTANTS.fov_margin * camera.height / (2 * camera.fy)
    return (
        -camera.cx / camera.fx - margin_x,
        (camera.width - camera.cx) / camera.fx + margin_x,
        -camera.cy / camera.fy - margin_y,
        (camera.height - camera.cy) / camera.fy + margin_y,
    )


class CameraNumbers(NamedTuple):
    """A camera as plain numbers for compiled kernels."""

    width: int  # px
    height: int
    tiles_x: int
    tiles_y: int
    fx: float
    fy: float
    pixel_cx: float  # px, integer pixel centres
    pixel_cy: float
    slope_x_min: float  # limits of x/z in the Jacobian
    slope_x_max: float
    slope_y_min: float
    slope_y_max: float
    r00: float
    r01: float
    r02: float
    r10: float
    r11: float
    r12: float
    r20: float
    r21: float
    r22: float
    center_x: float
    center_y: float
    center_z: float

    @classmethod
    def of(cls, camera: Camera) -> CameraNumbers:
        tile = CONSTANTS.tile
        return cls(
            camera.width,
            camera.height,
            -(-camera.width // tile),
            -(-camera.height // tile),
            float(camera.fx),  # kernels would be compiled again for whole numbers
            float(camera.fy),
            camera.cx - 0.5,
            camera.cy - 0.5,
            *slope_limits(camera),
            *map(float, camera.rotation.ravel()),
            *map(float, camera.center),
        )


@dataclass(frozen=True)
class Footprint:
    """The depth of each Gaussian, and sums over the pixels of one view that it is blended into.

    These are the pixels where its alpha is not skipped and that have not stopped before it. All
    fields are [N] and have no gradient. For a Gaussian without such pixels, all but ``depths`` are
    0.
    """

    pixels: Tensor  # int32, number of pixels
    depths: Tensor  # view z of the mean, world units
    values: Tensor  # sum over the pixels of the given values; 0 if none were given
    # px, sum over the pixels of the distance from the projected mean to the pixel's centre
    distances: Tensor


def view_depths(gaussians: Gaussians, camera: Camera) -> Tensor:
    """View z of each mean, [N] world units."""
    axis = gaussians.means.new_tensor(camera.rotation[2])
    return gaussians.means @ axis + float(camera.translation[2])


@dataclass
class RenderOutput(NamesAttributes):
    """One rendered view.

    - ``image`` is [H, W, 3], not clamped above; ``alpha`` is [H, W].
    - ``radii`` is [N] int32 in px, 0 for culled Gaussians, else positive.
    - ``screen_points`` is [N, 2], a leaf of zeros. After ``backward``, its ``.grad`` is the
      gradient of the loss by the projected means in NDC units, as in 3DGS (pixel gradient times
      W/2, H/2).
    - ``screen_gradient_abs`` is [N, 2], or None if not requested. ``backward`` fills it with the
      same gradient, but with the absolute value taken at each pixel before the sum (AbsGS, arXiv
      2404.10484).
    - ``footprint()`` computes the `Footprint` of this view, also after ``backward``;
      ``footprint(values)`` sums ``values`` [H, W] over its pixels, too. None if the rasterizer has
      no footprints.
    - ``depth`` is the expected depth along the camera's z, [H, W] world units, 0 where alpha is 0;
      None unless a part of the training asks for it (`gsbench.raster.depth.render_depth`).
    - ``extra`` is a leaf of zeros [N, …], or None if no extra output was requested. After
      ``backward``, its ``.grad`` is the extra output.
    """

    image: Tensor
    alpha: Tensor
    radii: Tensor
    screen_points: Tensor
    screen_gradient_abs: Tensor | None = None
    footprint: Callable[..., Footprint] | None = None
    extra: Tensor | None = None
    depth: Tensor | None = None

    @property
    def visible(self) -> Tensor:
        """[N] bool: the Gaussians that reach at least one tile."""
        return self.radii.bool()

    def require_footprint(self, values: Tensor | None = None) -> Footprint:
        """Return ``footprint(values)``. Raises RuntimeError if the rasterizer has no footprints."""
        if self.footprint is None:
            raise RuntimeError(
                "this densifier needs RenderOutput.footprint, which the rasterizer does not give"
            )
        return self.footprint(values)

    def require_extra(self) -> Tensor:
        """Return the extra output [N, …] of this view.

        Raises RuntimeError if none was requested, and before ``backward``.
        """
        if self.extra is None or self.extra.grad is None:
            raise RuntimeError(
                "this densifier needs an extra output: render with extra=NAME, then backward"
            )
        return self.extra.grad


class Rasterizer(Protocol):
    """The contract of rasterizers; ``tests/raster/test_contract.py`` tests all executors.

    Some outputs are optional. A class that gives ``RenderOutput.footprint`` has the class attribute
    ``has_footprint = True``. A class that gives ``RenderOutput.extra`` has ``extras``, the shape of
    each extra output for one Gaussian by name, for example ``{"splitting_matrix": (3, 3)}``; its
    ``render`` has a further argument ``extra: str | None = None``, the name of the one requested.

    Examples:
        The reference without colours. `departures` lists where it differs from the contract.

        >>> from gsbench.raster.contract import Case, departures
        >>> from gsbench.raster.reference import ReferenceRasterizer
        >>> class Grey:
        ...     name = "grey"
        ...
        ...     def render(self, gaussians, camera, *options, **more):
        ...         output = ReferenceRasterizer().render(gaussians, camera, *options, **more)
        ...         output.image = output.image.mean(-1, keepdim=True).expand(-1, -1, 3)
        ...         return output

        >>> rasterizer: Rasterizer = Grey()
        >>> tiny = Case(7, 5, 20, sh_degree=3)  # width, height, Gaussians
        >>> departures(rasterizer, cases=(tiny,))[0].partition(" by")[0]
        '7x5-n20-sh3: image is off'
    """

    name: str

    def render(
        self,
        gaussians: Gaussians,
        camera: Camera,
        sh_degree: int,
        background: Tensor,
        absolute_gradient: bool = False,
    ) -> RenderOutput:
        """Render ``gaussians`` from ``camera`` over ``background`` [3].

        Harmonics count up to ``sh_degree``, 0 to 3. Differentiable in the six tensors of
        ``gaussians`` and in ``screen_points``. Pixels are sampled at their centres, which are
        integers: a point projects to ``fx x/z + cx - 0.5``.
        """
        ...
