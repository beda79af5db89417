"""Peers that are no executors: what gsplat offers beside its parts, to measure against."""

from __future__ import annotations

import importlib
from typing import Any

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.gaussians.model import Gaussians
from gsbench.raster.base import RenderOutput
from gsbench.raster.executors import find
from gsbench.scene.camera import Camera


class TorchPeer:
    """Projection and colours by gsplat's pure-torch reference; its ``image`` is one tensor [N, 9] of these."""

    name = "gsplat-torch"
    device_type = "cpu"
    gives_image = False
    note = "projection and colour only, no compositing: gsplat's torch reference needs CUDA for the rest"

    def __init__(self) -> None:
        self._definitions = _import("gsplat.cuda._torch_impl", self.name)

    def render(
        self,
        gaussians: Gaussians,
        camera: Camera,
        sh_degree: int,
        background: Tensor,
        absolute_gradient: bool = False,
    ) -> RenderOutput:
        definitions = self._definitions
        pose, intrinsics = _pose_and_intrinsics(camera, gaussians.means)
        covariances, _ = definitions._quat_scale_to_covar_preci(gaussians.quaternions, gaussians.scales, True, False)
        radii, means, _, conics, _ = definitions._fully_fused_projection(
            gaussians.means, covariances, pose, intrinsics, camera.width, camera.height
        )
        directions = gaussians.means - torch.tensor(camera.center, dtype=torch.float32)
        colors = (definitions._spherical_harmonics(sh_degree, directions, _harmonics(gaussians)) + 0.5).clamp_min(0)
        numbers = torch.cat([means[0], conics[0], colors, gaussians.opacities[:, None]], -1)  # [N, 9]
        return RenderOutput(numbers, gaussians.opacities, radii[0].amax(-1), torch.zeros_like(means[0]))


class RasterizationPeer:
    """gsplat's own ``rasterization``, with the settings of its trainer: what its users run, with its own conventions.

    ``library`` is the module ``gsplat``, or one with the same function.
    """

    name = "gsplat-rasterization"
    device_type = "cuda"
    gives_image = True
    note = "gsplat's own function with its own conventions; no whole training steps, since it gives no screen gradient"

    def __init__(self, library: Any = None) -> None:
        self._library = _import("gsplat", self.name) if library is None else library

    def render(
        self,
        gaussians: Gaussians,
        camera: Camera,
        sh_degree: int,
        background: Tensor,
        absolute_gradient: bool = False,
    ) -> RenderOutput:
        pose, intrinsics = _pose_and_intrinsics(camera, gaussians.means)
        images, alphas, found = self._library.rasterization(
            gaussians.means,
            gaussians.quaternions,
            gaussians.scales,
            gaussians.opacities,
            _harmonics(gaussians),
            pose,
            intrinsics,
            camera.width,
            camera.height,
            sh_degree=sh_degree,
            packed=False,
            backgrounds=background[None],
            absgrad=absolute_gradient,
        )  # [1, H, W, 3], [1, H, W, 1]
        radii = found["radii"][0].amax(-1)  # [N]
        return RenderOutput(images[0], alphas[0, ..., 0], radii, torch.zeros_like(gaussians.means[:, :2]))


PEERS: dict[str, type[TorchPeer] | type[RasterizationPeer]] = {
    kind.name: kind for kind in (TorchPeer, RasterizationPeer)
}


def _import(module: str, peer: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise InputError(f"raster={peer} needs gsplat: {find('gsplat').install} ({error})") from error


def _pose_and_intrinsics(camera: Camera, like: Tensor) -> tuple[Tensor, Tensor]:
    """World to camera [1, 4, 4], and the intrinsics [1, 3, 3], beside ``like``."""
    pose = torch.eye(4)
    pose[:3, :3], pose[:3, 3] = torch.tensor(camera.rotation), torch.tensor(camera.translation)
    intrinsics = torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    return pose[None].to(like), intrinsics[None].to(like)


def _harmonics(gaussians: Gaussians) -> Tensor:
    return torch.cat([gaussians.sh_dc[:, None], gaussians.sh_rest], 1)  # [N, 16, 3]
