"""Code that executors share: checks of inputs, asynchronous reads, autograd for kernels."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gsbench.gaussians.model import MAX_SH_DEGREE, Gaussians
from gsbench.raster.base import Footprint, Rasterizer, RenderOutput
from gsbench.scene.types import Camera

MAX_SIDE = 16384  # px; a larger image is most likely a mistake in the settings
MIN_QUATERNION_NORM = 1e-12  # below, torch's ``normalize`` no longer gives a unit quaternion
# focal length over image side: fields of view between 0.2 arc seconds and 179.8 degrees
FOCAL_RANGE = (1e-3, 1e6)
# image sides; the largest distance of the principal point from the image corner
MAX_PRINCIPAL_OFFSET = 100.0


def check_inputs(gaussians: Gaussians, camera: Camera, sh_degree: int, background: Tensor) -> None:
    """Raise ValueError for inputs that ``Rasterizer.render`` cannot use; it names the parameter.

    This function reads every value of ``gaussians`` and waits for the device once. Executors that
    must not wait call only ``check_settings``. If their kernels then find a bad value, or if
    ``bad_values``, read later, is True, they call ``raise_for_values``.
    """
    check_settings(gaussians, camera, sh_degree, background)
    if bad_values(gaussians, background):
        raise_for_values(gaussians, background)


def bad_values(gaussians: Gaussians, background: Tensor) -> Tensor:
    """One bool, still on the device: whether ``raise_for_values`` must search for a bad value.

    It is always True if there is a bad value. It is also True if only a sum overflows.
    """
    tensors = [background, *gaussians.tensors().values()]
    # A sum is not finite if one of its values is not. Unlike a mask, it needs no memory.
    bad = ~torch.stack([tensor.detach().sum() for tensor in tensors]).isfinite().all()
    if len(gaussians):
        bad = bad | (gaussians.quaternions.detach().norm(dim=-1).amin() < MIN_QUATERNION_NORM)
    return bad


def check_settings(
    gaussians: Gaussians, camera: Camera, sh_degree: int, background: Tensor
) -> None:
    """The checks of ``check_inputs`` that do not wait for a device."""
    if not 0 <= sh_degree <= MAX_SH_DEGREE:
        raise ValueError(f"sh_degree: must be 0 to {MAX_SH_DEGREE}, got {sh_degree}")
    dtype, device = gaussians.means.dtype, gaussians.means.device
    if dtype not in (torch.float32, torch.float64):
        raise ValueError(f"gaussians: dtype must be float32 or float64, got {dtype}")
    for name, tensor in [*gaussians.tensors().items(), ("background", background)]:
        if tensor.dtype != dtype or tensor.device != device:
            raise ValueError(
                f"{name}: is {tensor.dtype} on {tensor.device}, but means is {dtype} on {device}"
            )
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
            raise ValueError(
                f"camera: {side} is {size} px, more than {MAX_SIDE}; resize the images"
            )
        if not FOCAL_RANGE[0] * size <= focal <= FOCAL_RANGE[1] * size:
            raise ValueError(
                f"camera: f{axis} is {focal} px, which is degenerate for a {side} of {size} px"
            )
        if abs(principal) > MAX_PRINCIPAL_OFFSET * size:
            raise ValueError(
                f"camera: c{axis} is {principal} px, which is degenerate for a {side} of {size} px"
            )


def _check_background(background: Tensor) -> None:
    if not torch.isfinite(background).all():
        raise ValueError(f"background: must be three finite numbers, got {background.tolist()}")


def raise_for_values(gaussians: Gaussians, background: Tensor | None = None) -> None:
    """Raise ValueError if a parameter is not finite, or if a quaternion has length 0."""
    if background is not None:
        _check_background(background)
    for name, tensor in gaussians.tensors().items():
        finite = torch.isfinite(tensor.detach())
        while finite.dim() > 1:
            finite = finite.all(-1)  # finally [N]
        if not finite.all():
            index = int((~finite).nonzero()[0])
            raise ValueError(
                f"{name}: not finite at Gaussian {index} ({int((~finite).sum())} in all)"
            )
    short = gaussians.quaternions.detach().norm(dim=-1) < MIN_QUATERNION_NORM  # [N]
    if short.any():
        index = int(short.nonzero()[0])
        raise ValueError(f"quaternions: length 0 at Gaussian {index} ({int(short.sum())} in all)")


def make_probe(rasterizer: Rasterizer, extra: str | None, means: Tensor) -> Tensor | None:
    """Zeros [N, …] that require a gradient, which will be the output ``extra``; None for None.

    ``means`` are those of the N Gaussians. Raises ValueError if the rasterizer has no such output.
    """
    if extra is None:
        return None
    shapes: Mapping[str, tuple[int, ...]] = getattr(rasterizer, "extras", {})
    if extra not in shapes:
        choices = ", ".join(shapes) or "no extra output"
        raise ValueError(f"extra: raster={rasterizer.name} gives {choices}, not {extra}")
    return means.new_zeros(len(means), *shapes[extra], requires_grad=True)


def upload(numbers: Sequence[float], device: torch.device) -> Tensor:
    """The ``numbers`` as float32 on ``device``; the host does not wait for the copy."""
    # A copy is asynchronous only from page-locked memory.
    host = torch.empty(len(numbers), pin_memory=device.type == "cuda")
    host.numpy()[:] = numbers
    return host.to(device, non_blocking=True)


class Readback:
    """An asynchronous copy of a small tensor to the host.

    On a CUDA device, the copy is queued in the stream and the host continues. ``values`` waits for
    the copy, which takes no time if the device has finished it, for example an iteration later. On
    other devices the copy is immediate. The class variable ``waits`` counts how often any
    ``values`` had to wait.
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
        """Return whether ``values`` returns without waiting."""
        return self._event is None or self._event.query()

    def values(self) -> Tensor:
        """Wait for the copy, if necessary, and return the values as a tensor on the CPU."""
        if not self.arrived:
            Readback.waits += 1
        if self._event is not None:
            self._event.synchronize()
            self._event = None
        return self._host


FrameT = TypeVar("FrameT")


class Lifetime:
    """A token for leased memory: the pools take the memory back when the token is freed."""


class RenderRequest(NamedTuple):
    """The inputs of one render besides the Gaussians, and ``absolute``, a buffer for an output."""

    camera: Camera
    degree: int
    background: Tensor
    absolute: Tensor | None  # [N, 2] filled by the backward pass
    extra: str | None  # name of the extra output
    lifetime: Lifetime  # of the frame's memory: the graph and the footprint refer to this request


class Gradients(NamedTuple):
    """Gradients by the six tensors and the screen points, and the extra output, if requested."""

    tensors: list[Tensor]
    screen: Tensor  # [N, 2]
    extra: Tensor | None  # [N, …]


class StagedRasterizer(ABC, Generic[FrameT]):
    """A rasterizer with separate stages.

    Its forward pass leaves a frame for the backward pass and the footprint. This class implements
    ``render`` of the contract and the connection with autograd. A subclass implements the stages;
    all tensors that they get are contiguous.
    """

    name: str
    extras: ClassVar[Mapping[str, tuple[int, ...]]] = {}  # see `raster.base.Rasterizer`

    @abstractmethod
    def check(self, gaussians: Gaussians) -> None:
        """Raise ValueError if the stages cannot use tensors of this dtype or device."""

    @abstractmethod
    def forward(
        self, gaussians: Gaussians, request: RenderRequest
    ) -> tuple[Tensor, Tensor, Tensor, FrameT]:
        """Return image [H, W, 3], alpha [H, W], radii [N] and the frame.

        The memory of the frame is leased until ``request.lifetime`` is freed.
        """

    @abstractmethod
    def backward(
        self,
        frame: FrameT,
        gaussians: Gaussians,
        request: RenderRequest,
        g_image: Tensor,
        g_alpha: Tensor | None,
    ) -> Gradients:
        """Compute the gradients of the loss from those by image and alpha."""

    @abstractmethod
    def footprint(
        self,
        frame: FrameT,
        gaussians: Gaussians,
        request: RenderRequest,
        values: Tensor | None = None,
    ) -> Footprint:
        """See ``raster.base.RenderOutput``."""

    def render(
        self,
        gaussians: Gaussians,
        camera: Camera,
        sh_degree: int,
        background: Tensor,
        absolute_gradient: bool = False,
        extra: str | None = None,
    ) -> RenderOutput:
        """See `gsbench.raster.base.Rasterizer`.

        Raises ValueError, which names the parameter, for an input that cannot be used.
        """
        check_settings(gaussians, camera, sh_degree, background)
        self.check(gaussians)
        screen_points = torch.zeros_like(gaussians.means[:, :2], requires_grad=True)
        absolute = torch.zeros_like(screen_points) if absolute_gradient else None
        probe = make_probe(self, extra, gaussians.means)
        request = RenderRequest(
            camera, sh_degree, background.detach().contiguous(), absolute, extra, Lifetime()
        )
        tensors = gaussians.tensors().values()
        image, alpha, radii, frame = _Render.apply(
            self, request, background, screen_points, probe, *tensors
        )
        # Detached: the output would otherwise keep the caller's graph alive.
        footprint = partial(self.footprint, frame, gaussians.detach(), request)
        return RenderOutput(image, alpha, radii, screen_points, absolute, footprint, probe)


class _Render(torch.autograd.Function):
    """The node of a render in autograd's graph.

    It keeps no reference to itself, so it is freed with the graph.
    """

    @staticmethod
    def forward(
        ctx: Any,
        rasterizer: StagedRasterizer[FrameT],
        request: RenderRequest,
        background: Tensor,
        screen_points: Tensor,
        probe: Tensor | None,
        *tensors: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor, FrameT]:
        gaussians = Gaussians(*(tensor.contiguous() for tensor in tensors))
        image, alpha, radii, frame = rasterizer.forward(gaussians, request)
        ctx.rasterizer, ctx.frame, ctx.request = rasterizer, frame, request
        _, _, wants_background, *_ = ctx.needs_input_grad
        ctx.save_for_backward(alpha if wants_background else None, *gaussians.tensors().values())
        # Most losses have no gradient by alpha: None saves a picture of zeros and the pass over it.
        ctx.set_materialize_grads(False)
        return image, alpha, radii, frame

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, g_image: Tensor | None, g_alpha: Tensor | None, *_: None
    ) -> tuple[Tensor | None, ...]:
        alpha, *tensors = ctx.saved_tensors
        request: RenderRequest = ctx.request
        # Only alpha was differentiated.
        if g_image is None:
            g_image = request.background.new_zeros(request.camera.height, request.camera.width, 3)
        g_image = g_image.contiguous()
        g_alpha = None if g_alpha is None else g_alpha.contiguous()
        gradients = ctx.rasterizer.backward(
            ctx.frame, Gaussians(*tensors), request, g_image, g_alpha
        )
        g_background = None if alpha is None else (g_image * (1 - alpha).unsqueeze(-1)).sum((0, 1))
        return None, None, g_background, gradients.screen, gradients.extra, *gradients.tensors


class KernelLoss(ABC):
    """The loss of float32 images by kernels that know its gradient."""

    def __call__(self, image: Tensor, target: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        if target.dtype != torch.uint8:
            target = target.to(torch.float32)
        loss, l1, similarity = _Differentiable.apply(self, image, target.contiguous())
        return loss, l1, similarity

    @abstractmethod
    def compute(
        self, image: Tensor, target: Tensor, differentiate: bool
    ) -> tuple[Tensor, Tensor | None]:
        """Return loss, L1 and SSIM, [3], and the loss's gradient by ``image``, if wanted.

        ``image`` and ``target``, which is uint8 or float32, are contiguous.
        """


class _Differentiable(torch.autograd.Function):
    """Computes the gradient in ``forward``; ``backward`` only scales it."""

    @staticmethod
    def forward(
        ctx: Any, compiled: KernelLoss, image: Tensor, target: Tensor
    ) -> tuple[Tensor, ...]:
        pixels, wanted = image.detach().contiguous(), ctx.needs_input_grad[1]
        values, ctx.gradient = compiled.compute(pixels, target, wanted)
        loss, *shown = values.unbind()
        ctx.mark_non_differentiable(*shown)
        ctx.set_materialize_grads(False)
        return loss.clone(), *shown  # a view could not be added to in place

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_loss: Tensor | None, *_: None) -> tuple[None, Tensor | None, None]:
        if g_loss is None or ctx.gradient is None:
            return None, None, None
        # On a GPU, a look at the factor would wait for the device.
        is_one = g_loss.device.type == "cpu" and float(g_loss) == 1.0
        return None, ctx.gradient if is_one else ctx.gradient * g_loss, None
