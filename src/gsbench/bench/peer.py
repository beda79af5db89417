"""A peer that is no executor, to measure against: gsplat's own function."""

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


class RasterizationPeer:
    """gsplat's own ``rasterization``, with the settings of its trainer: what its users run, with its own conventions.

    ``library`` is the module ``gsplat``, or one with the same function.
    """

    name = "gsplat-rasterization"
    device_type = "cuda"
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


PEERS = {RasterizationPeer.name: RasterizationPeer}


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
