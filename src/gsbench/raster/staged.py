"""Parts that executors share: checks of their inputs, values read back without a wait, and for compiled ones a bridge
between their stages and autograd."""

from abc import ABC, abstractmethod
from functools import partial
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gsbench.gaussians.model import MAX_SH_DEGREE, Gaussians
from gsbench.raster.base import Footprint, RenderOutput
from gsbench.scene.camera import Camera

MAX_SIDE = 16384  # px; beyond it an image is taken for a slip in the settings, not for a wish
MIN_QUATERNION_NORM = 1e-12  # below, torch's ``normalize`` no longer gives a unit quaternion, so no rotation
FOCAL_RANGE = (1e-3, 1e6)  # focal length over image side: fields of view between 0.2 arc seconds and 179.8 degrees
MAX_PRINCIPAL_OFFSET = 100.0  # image sides that the principal point may lie outside the image


def check_inputs(gaussians: Gaussians, camera: Camera, sh_degree: int, background: Tensor) -> None:
    """Raise ValueError, naming the parameter, on anything that ``Rasterizer.render`` cannot use.

    Looks at every value of ``gaussians``, and waits for a device once. An executor that meets the values anyway calls
    ``check_settings`` alone and ``raise_for_values`` when it finds a bad one; one that waits for its device later asks
    ``bad_values`` and reads the answer then.
    """
    check_settings(gaussians, camera, sh_degree, background)
    if bad_values(gaussians, background):
        raise_for_values(gaussians, background)


def bad_values(gaussians: Gaussians, background: Tensor) -> Tensor:
    """One bool, still on the device: whether ``raise_for_values`` has to look.

    It may be True for sound values whose sum overflows; it is never False for a bad one.
    """
    tensors = [background, *gaussians.tensors().values()]
    bad = ~torch.stack([tensor.detach().sum() for tensor in tensors]).isfinite().all()
    if len(gaussians):
        bad = bad | (gaussians.quaternions.detach().norm(dim=-1).amin() < MIN_QUATERNION_NORM)
    return bad


def check_settings(gaussians: Gaussians, camera: Camera, sh_degree: int, background: Tensor) -> None:
    """The part of ``check_inputs`` that looks at no value that a device would have to be waited for."""
    if not 0 <= sh_degree <= MAX_SH_DEGREE:
        raise ValueError(f"sh_degree: must be 0 to {MAX_SH_DEGREE}, got {sh_degree}")
    dtype, device = gaussians.means.dtype, gaussians.means.device
    if dtype not in (torch.float32, torch.float64):
        raise ValueError(f"gaussians: dtype must be float32 or float64, got {dtype}")
    for name, tensor in [*gaussians.tensors().items(), ("background", background)]:
        if tensor.dtype != dtype or tensor.device != device:
            raise ValueError(f"{name}: is {tensor.dtype} on {tensor.device}, but means is {dtype} on {device}")
    if tuple(background.shape) != (3,):
        raise ValueError(f"background: must be three numbers, got shape {tuple(background.shape)}")
    if device.type == "cpu":
        _check_background(background)
    _check_camera(camera)


def _check_camera(camera: Camera) -> None:
    for side, size, focal, principal in (
        ("width", camera.width, camera.fx, camera.cx),
        ("height", camera.height, camera.fy, camera.cy),
    ):
        axis = "x" if side == "width" else "y"
        if size > MAX_SIDE:
            raise ValueError(f"camera: {side} is {size} px, more than {MAX_SIDE}; resize the images")
        if not FOCAL_RANGE[0] * size <= focal <= FOCAL_RANGE[1] * size:
            raise ValueError(f"camera: f{axis} is {focal} px, which is degenerate for a {side} of {size} px")
        if abs(principal) > MAX_PRINCIPAL_OFFSET * size:
            raise ValueError(f"camera: c{axis} is {principal} px, which is degenerate for a {side} of {size} px")


def _check_background(background: Tensor) -> None:
    if not torch.isfinite(background).all():
        raise ValueError(f"background: must be three finite numbers, got {background.tolist()}")


def raise_for_values(gaussians: Gaussians, background: Tensor | None = None) -> None:
    """Raise ValueError on the first parameter that has a non-finite value or, of quaternions, no length."""
    if background is not None:
        _check_background(background)
    for name, tensor in gaussians.tensors().items():
        finite = torch.isfinite(tensor.detach())
        while finite.dim() > 1:
            finite = finite.all(-1)  # in the end [N]
        if not finite.all():
            index = int((~finite).nonzero()[0])
            raise ValueError(f"{name}: not finite at Gaussian {index} ({int((~finite).sum())} in all)")
    short = gaussians.quaternions.detach().norm(dim=-1) < MIN_QUATERNION_NORM  # [N]
    if short.any():
        index = int(short.nonzero()[0])
        raise ValueError(f"quaternions: no length, so no rotation, at Gaussian {index} ({int(short.sum())} in all)")


class Readback:
    """The values of a small tensor, copied to the host behind the device's back.

    On a CUDA device the copy is put into the stream and the host goes on; ``values`` waits for it, which costs nothing
    once the device has come so far, for example an iteration later. On any other device the values are there at once.
    ``waits`` counts, over all of them, how often that was too early.
    """

    waits: ClassVar[int] = 0

    def __init__(self, source: Tensor) -> None:
        self._event: torch.cuda.Event | None = None
        source = source.detach()
        if source.device.type == "cuda":
            self._host = torch.empty(source.shape, dtype=source.dtype, pin_memory=True)
            self._host.copy_(source, non_blocking=True)
            self._event = torch.cuda.Event()
            self._event.record(torch.cuda.current_stream(source.device))
        else:
            self._host = source.cpu()

    @property
    def arrived(self) -> bool:
        """Return whether ``values`` would not wait."""
        return self._event is None or self._event.query()

    def values(self) -> Tensor:
        """The values as a tensor on the CPU."""
        if not self.arrived:
            Readback.waits += 1
        if self._event is not None:
            self._event.synchronize()
            self._event = None
        return self._host


FrameT = TypeVar("FrameT")


class Lifetime:
    """Lives as long as what was leased for it is needed: pools take memory back when it is freed."""


class Request(NamedTuple):
    """Settings of one render, beside the Gaussians. ``absolute`` [N, 2] is filled by the backward pass."""

    camera: Camera
    degree: int
    background: Tensor
    absolute: Tensor | None


class Gradients(NamedTuple):
    """Gradients of the six tensors, of ``screen_points`` and, where they are asked for, the splitting matrices."""

    tensors: list[Tensor]
    screen: Tensor  # [N, 2]
    splitting: Tensor | None  # [N, 3, 3]


class StagedRasterizer(ABC, Generic[FrameT]):
    """A rasterizer whose forward pass leaves a frame for its backward pass and for questions after its footprint.

    The render of the contract is here, and the bridge to autograd; a subclass has the stages. What these get is
    contiguous.
    """

    name: str

    @abstractmethod
    def check(self, gaussians: Gaussians) -> None:
        """Raise ValueError where the stages cannot use tensors of this type or device."""

    @abstractmethod
    def forward(
        self, lifetime: Lifetime, gaussians: Gaussians, request: Request
    ) -> tuple[Tensor, Tensor, Tensor, FrameT]:
        """Return image [H, W, 3], alpha [H, W], radii [N], and the frame, whose memory is held by ``lifetime``."""

    @abstractmethod
    def backward(
        self,
        frame: FrameT,
        gaussians: Gaussians,
        request: Request,
        g_image: Tensor,
        g_alpha: Tensor | None,
        want_splitting: bool,
    ) -> Gradients:
        """Carry the gradients of image and alpha back."""

    @abstractmethod
    def footprint(self, frame: FrameT, gaussians: Gaussians, camera: Camera, values: Tensor | None = None) -> Footprint:
        """See ``raster.base.RenderOutput``."""

    def render(
        self,
        gaussians: Gaussians,
        camera: Camera,
        sh_degree: int,
        background: Tensor,
        absolute_gradient: bool = False,
        splitting_matrix: bool = False,
    ) -> RenderOutput:
        """Render as ``raster.base.Rasterizer`` says. Raises ValueError naming the parameter that cannot be used."""
        check_settings(gaussians, camera, sh_degree, background)
        self.check(gaussians)
        screen_points = torch.zeros_like(gaussians.means[:, :2], requires_grad=True)
        absolute = torch.zeros_like(screen_points) if absolute_gradient else None
        probe = screen_points.new_zeros(len(gaussians), 3, 3, requires_grad=True) if splitting_matrix else None
        request = Request(camera, sh_degree, background.detach().contiguous(), absolute)
        kept: _Kept[FrameT] = _Kept()
        tensors = gaussians.tensors().values()
        image, alpha, radii = _Render.apply(self, kept, request, background, screen_points, probe, *tensors)
        footprint = partial(_footprint, self, kept, gaussians.map(Tensor.detach), camera)
        return RenderOutput(image, alpha, radii, screen_points, absolute, footprint, probe)


class _Kept(Generic[FrameT]):
    """State that a render keeps for the backward pass and for its footprint, and the hold on the memory of it."""

    frame: FrameT
    lifetime: Lifetime


def _footprint(
    rasterizer: StagedRasterizer[FrameT],
    kept: _Kept[FrameT],
    gaussians: Gaussians,
    camera: Camera,
    values: Tensor | None = None,
) -> Footprint:
    """See ``raster.base.RenderOutput``; the frame's memory stays held as long as this can be asked for."""
    return rasterizer.footprint(kept.frame, gaussians, camera, values)


class _Render(torch.autograd.Function):
    """The node of a render in autograd's graph. Nothing that it keeps refers back to it."""

    @staticmethod
    def forward(
        ctx: Any,
        rasterizer: StagedRasterizer[Any],
        kept: _Kept[Any],
        request: Request,
        background: Tensor,
        screen_points: Tensor,
        probe: Tensor | None,
        *tensors: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        gaussians = Gaussians(*(tensor.contiguous() for tensor in tensors))
        kept.lifetime = Lifetime()
        image, alpha, radii, kept.frame = rasterizer.forward(kept.lifetime, gaussians, request)
        ctx.rasterizer, ctx.kept, ctx.request = rasterizer, kept, request
        _, _, _, wants_background, *_ = ctx.needs_input_grad
        ctx.save_for_backward(alpha if wants_background else None, *gaussians.tensors().values())
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(radii)
        return image, alpha, radii

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_image: Tensor | None, g_alpha: Tensor | None, _: None) -> tuple[Tensor | None, ...]:
        alpha, *tensors = ctx.saved_tensors
        request: Request = ctx.request
        if g_image is None:
            g_image = request.background.new_zeros(request.camera.height, request.camera.width, 3)
        g_image = g_image.contiguous()
        g_alpha = None if g_alpha is None else g_alpha.contiguous()
        _, _, _, _, _, wants_splitting, *_ = ctx.needs_input_grad
        found = ctx.rasterizer.backward(ctx.kept.frame, Gaussians(*tensors), request, g_image, g_alpha, wants_splitting)
        g_background = None if alpha is None else (g_image * (1 - alpha).unsqueeze(-1)).sum((0, 1))
        return None, None, None, g_background, found.screen, found.splitting, *found.tensors
