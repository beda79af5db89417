"""Compiled rasterizers as executors of the contract: one bridge between their stages and autograd."""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import partial
from typing import Any, Generic, NamedTuple, TypeVar

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gsbench.gaussians.model import Gaussians
from gsbench.raster.base import Footprint, RenderOutput
from gsbench.raster.validate import check_settings
from gsbench.scene.camera import Camera

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
