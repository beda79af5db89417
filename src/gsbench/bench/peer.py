"""gsplat's torch definitions as a peer on the CPU: the part of a render that they can do there."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.gaussians.model import Gaussians
from gsbench.raster.base import RenderOutput
from gsbench.scene.camera import Camera
from gsbench.system.install import install_command

PEER = "gsplat-torch"
PEER_NOTE = "projection and colour only, no compositing: gsplat's torch reference needs CUDA for the rest"


class TorchPeer:
    """Projection and colours by gsplat's pure-torch reference; its ``image`` is one tensor [N, 9] of these."""

    name = PEER

    def __init__(self) -> None:
        try:
            from gsplat.cuda import _torch_impl
        except ImportError as error:
            raise InputError(f"raster={PEER} needs gsplat: {install_command('gsplat')} ({error})") from error
        self._definitions: Any = _torch_impl

    def render(
        self,
        gaussians: Gaussians,
        camera: Camera,
        sh_degree: int,
        background: Tensor,
        absolute_gradient: bool = False,
    ) -> RenderOutput:
        definitions = self._definitions
        pose = torch.eye(4)
        pose[:3, :3], pose[:3, 3] = torch.tensor(camera.rotation), torch.tensor(camera.translation)
        intrinsics = torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        covariances, _ = definitions._quat_scale_to_covar_preci(gaussians.quaternions, gaussians.scales, True, False)
        radii, means, _, conics, _ = definitions._fully_fused_projection(
            gaussians.means, covariances, pose[None], intrinsics[None], camera.width, camera.height
        )
        coefficients = torch.cat([gaussians.sh_dc[:, None], gaussians.sh_rest], 1)  # [N, 16, 3]
        directions = gaussians.means - torch.tensor(camera.center, dtype=torch.float32)
        colors = (definitions._spherical_harmonics(sh_degree, directions, coefficients) + 0.5).clamp_min(0)
        numbers = torch.cat([means[0], conics[0], colors, gaussians.opacities[:, None]], -1)  # [N, 9]
        return RenderOutput(numbers, gaussians.opacities, radii[0].amax(-1), torch.zeros_like(means[0]))
