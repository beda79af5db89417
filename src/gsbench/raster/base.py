"""The contract of every rasterizer: what goes in, what comes out, and the constants of 3DGS. Loads no torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from torch import Tensor

    from gsbench.gaussians.model import Gaussians
    from gsbench.scene.camera import Camera


@dataclass(frozen=True)
class RasterConstants:
    """The numbers of the 2023 reference implementation of 3DGS (Kerbl et al.), in the order of the pipeline."""

    near: float = 0.2  # world units; a Gaussian whose centre has view z <= near is culled
    fov_margin: float = 0.3  # the Jacobian's x/z, y/z are clamped to the image plus 0.3 tan(fov/2) on each side
    blur: float = 0.3  # px^2, added to the diagonal of the 2D covariance
    sigma_extent: float = 3.0  # radius = ceil(3 sqrt(lambda_max)) px
    eigenvalue_floor: float = 0.1  # inside the square root of lambda_max
    tile: int = 16  # px; a Gaussian reaches every pixel of every tile that its square of 2 radius touches
    alpha_min: float = 1.0 / 255.0  # a contribution below is skipped
    alpha_max: float = 0.99  # a contribution is clamped to it (the gradient passes, as in the reference)
    transmittance_min: float = 1e-4  # a pixel stops before the Gaussian that would bring it below


CONSTANTS = RasterConstants()


def slope_limits(camera: Camera, constants: RasterConstants = CONSTANTS) -> tuple[float, float, float, float]:
    """The limits of x/z (least, most) and of y/z in the Jacobian of a projection (`RasterConstants.fov_margin`)."""
    margin_x = constants.fov_margin * camera.width / (2 * camera.fx)
    margin_y = constants.fov_margin * camera.height / (2 * camera.fy)
    return (
        -camera.cx / camera.fx - margin_x,
        (camera.width - camera.cx) / camera.fx + margin_x,
        -camera.cy / camera.fy - margin_y,
        (camera.height - camera.cy) / camera.fy + margin_y,
    )


def projection_numbers(camera: Camera) -> list[float]:
    """A camera as the compiled kernels take it: focal lengths and principal point, px, with integer pixel centres;
    limits of the slopes; rotation, row by row; centre."""
    return [
        camera.fx,
        camera.fy,
        camera.cx - 0.5,
        camera.cy - 0.5,
        *slope_limits(camera),
        *map(float, camera.rotation.ravel()),
        *map(float, camera.center),
    ]


@dataclass(frozen=True)
class Footprint:
    """The pixels of one view that each Gaussian is blended into: those where its alpha is not skipped and that have not
    stopped before it.

    All are [N] and carry no gradient; where there is no such pixel, all but ``depths`` are 0.
    """

    pixels: Tensor  # int32, how many
    depths: Tensor  # view z of the mean, world units
    values: Tensor  # sum over them of the values that were asked about; 0 where none were
    distances: Tensor  # sum over them of the distance from the projected mean to the pixel's centre, px


def view_depths(gaussians: Gaussians, camera: Camera) -> Tensor:
    """View z of each mean, [N] world units."""
    return gaussians.means.detach() @ gaussians.means.new_tensor(camera.rotation[2]) + camera.translation[2]


class FootprintOf(Protocol):
    """A request for a footprint, for one view that was rendered."""

    def __call__(self, values: Tensor | None = None) -> Footprint: ...


@dataclass
class RenderOutput:
    """One rendered view.

    ``image`` is [H, W, 3], not clamped above; ``alpha`` is [H, W]; ``radii`` is [N] int32 in px, 0 where a Gaussian was
    culled. ``screen_points`` is [N, 2], all zero, and a leaf: after ``backward`` its ``.grad`` is the gradient of the
    loss with respect to the projected means in NDC units, as 3DGS's densification reads it (pixel gradient times W/2,
    H/2). ``screen_gradient_abs`` is [N, 2], filled by ``backward`` with the same sum over pixels of absolute values
    (AbsGS, arXiv 2404.10484), or None if it was not asked for.

    ``footprint()`` says which pixels each Gaussian was blended into; ``footprint(values)`` sums ``values`` [H, W] over
    them too. It takes its time when it is called, which may be after ``backward``. None where the rasterizer cannot
    say.

    ``splitting_probe`` is [N, 3, 3], all zero, and a leaf, or None if it was not asked for: after ``backward`` its
    ``.grad`` is each Gaussian's splitting matrix in this view, per world unit squared (SteepGS, arXiv 2505.05587): the
    sum over pixels of (d loss / d s) times the second derivative of s by the position of the mean, for s the opacity
    times the density at the pixel, before the clamp to ``alpha_max``. The projection is taken as linear there and the
    covariance on the image as fixed.
    """

    image: Tensor
    alpha: Tensor
    radii: Tensor
    screen_points: Tensor
    screen_gradient_abs: Tensor | None = None
    footprint: FootprintOf | None = None
    splitting_probe: Tensor | None = None

    @property
    def visible(self) -> Tensor:
        """[N] bool: the Gaussians that reach at least one tile."""
        return self.radii > 0

    def require_footprint(self, values: Tensor | None = None) -> Footprint:
        """``footprint(values)``. Raises RuntimeError where the rasterizer cannot say."""
        if self.footprint is None:
            raise RuntimeError("this densifier needs RenderOutput.footprint, which the rasterizer does not give")
        return self.footprint(values)

    def require_splitting_matrix(self) -> Tensor:
        """The splitting matrices [N, 3, 3] of this view. Raises RuntimeError where they were not asked for, or before
        ``backward``."""
        if self.splitting_probe is None or self.splitting_probe.grad is None:
            raise RuntimeError(
                "this densifier needs splitting matrices: render with splitting_matrix=True, then backward"
            )
        return self.splitting_probe.grad


class Rasterizer(Protocol):
    """An executor of the contract; every one passes ``tests/raster/test_contract.py``.

    One of a user's that gives ``RenderOutput.footprint``, which is optional, has a class attribute ``has_footprint =
    True``; one that gives splitting matrices has ``has_splitting_matrix = True``, and its ``render`` has one argument
    more, ``splitting_matrix: bool = False``.

    Examples:
        The reference without colours; `departures` says what is not as the contract wants it.

        >>> from gsbench.raster.contract import Case, departures
        >>> from gsbench.raster.reference import ReferenceRasterizer
        >>> class Grey:
        ...     name = "grey"
        ...
        ...     def render(self, gaussians, camera, sh_degree, background, absolute_gradient=False):
        ...         output = ReferenceRasterizer().render(gaussians, camera, sh_degree, background, absolute_gradient)
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
        """Render ``gaussians`` from ``camera`` with harmonics up to ``sh_degree`` (0 to 3) over ``background`` [3].

        Differentiable in the six tensors of ``gaussians`` and in ``screen_points``. Pixel (column i, row j) is sampled
        at its centre: a point projects to ``fx x/z + cx - 0.5`` in units where pixel centres are integers.
        """
        ...
