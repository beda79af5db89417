"""Maps of a test view: each pixel's depth, its distance from the initial cloud, and the volume of its Gaussians."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from gsbench.densify.volumetric import log_volume
from gsbench.gaussians.model import Gaussians, rgb_to_dc
from gsbench.raster.base import Rasterizer
from gsbench.scene.camera import Camera

MIN_ALPHA = 0.5  # a pixel that is covered less shows no surface: not a number


def view_maps(
    rasterizer: Rasterizer, gaussians: Gaussians, camera: Camera, initial_points: cKDTree
) -> dict[str, NDArray[np.float32]]:
    """Maps [H, W] of one view, NaN where no surface is seen; world units.

    ``depth``: view z, the mean over the Gaussians of a pixel weighted by their contribution. ``distance``: from the
    point at that depth to the nearest of ``initial_points``. ``volume``: of the Gaussians, the weighted geometric mean.
    """
    view_z = _view_z(gaussians, camera)
    volumes = log_volume(gaussians.log_scales)  # [N]
    lowest = volumes.min()
    features = torch.stack(
        [view_z.clamp_min(0), volumes - lowest, torch.zeros_like(view_z)], -1
    )  # [N, 3], none negative
    mean = _mean_seen(*paint(rasterizer, gaussians, features, camera))
    depth = mean[..., 0].double().cpu().numpy()  # [H, W]
    volume = torch.exp(mean[..., 1] + lowest).cpu().numpy()
    distance = np.full_like(depth, np.nan)
    covered = np.isfinite(depth)
    distance[covered] = initial_points.query(unproject(depth, camera)[covered])[0]
    maps = {"depth": depth, "distance": distance, "volume": volume}
    return {name: values.astype(np.float32) for name, values in maps.items()}


def surface_depth(rasterizer: Rasterizer, gaussians: Gaussians, camera: Camera) -> NDArray[np.float64]:
    """The view z [H, W] of what each pixel shows, as in `view_maps`; not a number where no surface is seen."""
    view_z = _view_z(gaussians, camera).clamp_min(0)
    features = torch.stack([view_z, torch.zeros_like(view_z), torch.zeros_like(view_z)], -1)  # [N, 3]
    return _mean_seen(*paint(rasterizer, gaussians, features, camera))[..., 0].double().cpu().numpy()


def paint(rasterizer: Rasterizer, gaussians: Gaussians, features: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """The Gaussians blended with ``features`` [N, 3], none negative, as colours: sums [H, W, 3], and alpha [H, W]."""
    painted = Gaussians(**(gaussians.tensors() | {"sh_dc": rgb_to_dc(features)}))
    with torch.no_grad():
        out = rasterizer.render(painted, camera, 0, torch.zeros_like(features[0]))
    return out.image, out.alpha


def _mean_seen(sums: Tensor, alpha: Tensor) -> Tensor:
    """Painted values, as a mean over the Gaussians of each pixel, [H, W, 3]; NaN where no surface is seen."""
    seen = (alpha >= MIN_ALPHA).unsqueeze(-1)
    return torch.where(seen, sums / alpha.clamp_min(MIN_ALPHA).unsqueeze(-1), math.nan)


def _view_z(gaussians: Gaussians, camera: Camera) -> Tensor:
    """[N], world units along the camera's axis."""
    return gaussians.means @ gaussians.means.new_tensor(camera.rotation[2]) + float(camera.translation[2])


def unproject(depth: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    """The world points [H, W, 3] of the pixel centres at ``depth`` [H, W] along z."""
    rows, columns = np.mgrid[: camera.height, : camera.width]
    x = (columns + 0.5 - camera.cx) / camera.fx * depth
    y = (rows + 0.5 - camera.cy) / camera.fy * depth
    in_view = np.stack([x, y, depth], -1)  # [H, W, 3]
    return (in_view - camera.translation) @ camera.rotation
