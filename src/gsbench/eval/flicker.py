"""Flicker: how far neighbouring renders of a camera path differ where they show the same points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from gsbench.scene.camera import Camera

SAME_SURFACE = 0.05  # relative: where depths differ by less, two frames show the same point
REACH = 5  # px a side: around a point, all that the cubic mixes must be of one surface
MARGIN = 2.0  # px from the border, within which the cubic lacks neighbours
BYTE_MAX = 255.0


def flicker(frame: Tensor, points: NDArray[np.float64], following: Tensor, depth: Tensor, camera: Camera) -> float:
    """The mean absolute difference, in 8-bit levels, between a frame and the next one at the same points of the scene.

    ``frame`` and ``following`` are [H, W, 3] in [0, 1]; ``points`` [H, W, 3] are the world points that the first shows
    (not a number where none); ``depth`` [H, W] and ``camera`` are the next frame's. What is hidden in it, or outside
    it, does not count; without any pixel that does, not a number. Colours between pixels come from a cubic: what that
    rounds off counts as flicker, so compare models of like sharpness.
    """
    places = torch.from_numpy(points).to(frame)  # [H, W, 3]
    in_view = places @ frame.new_tensor(camera.rotation).T + frame.new_tensor(camera.translation)
    z = in_view[..., 2]
    x = camera.fx * in_view[..., 0] / z + camera.cx  # px
    y = camera.fy * in_view[..., 1] / z + camera.cy
    grid = torch.stack([2 * x / camera.width - 1, 2 * y / camera.height - 1], -1).nan_to_num(nan=2.0)  # [H, W, 2]

    def sample(image: Tensor, mode: str) -> Tensor:
        """``image`` [C, H, W] at the grid, [C, H, W]."""
        return F.grid_sample(image[None], grid[None], mode=mode, padding_mode="border", align_corners=False)[0]

    known = depth[None].to(frame)  # [1, H, W]
    farthest = F.max_pool2d(known.nan_to_num(nan=torch.inf), REACH, 1, REACH // 2)
    nearest = -F.max_pool2d(-known.nan_to_num(nan=0.0), REACH, 1, REACH // 2)
    around = sample(torch.cat([nearest, farthest]), "nearest")  # [2, H, W]
    inside = (x > MARGIN) & (x < camera.width - MARGIN) & (y > MARGIN) & (y < camera.height - MARGIN)
    same = (z > 0) & inside & ((around - z).abs() < SAME_SURFACE * z).all(0)
    seen = sample(following.permute(2, 0, 1), "bicubic").permute(1, 2, 0).clamp(0, 1)
    return float((seen - frame).abs()[same].mean()) * BYTE_MAX


def camera_path(start: Camera, end: Camera, shares: ArrayLike) -> list[Camera]:
    """Cameras with the picture of ``start`` on the way to the pose of ``end``; a share of 0 is the start, 1 the end."""
    along = np.asarray(shares, dtype=np.float64)  # [T]
    turns = Slerp([0.0, 1.0], Rotation.from_matrix(np.stack([start.rotation, end.rotation])))(along)
    cameras = []
    for share, rotation in zip(along, turns.as_matrix(), strict=True):
        center = (1 - share) * start.center + share * end.center
        cameras.append(replace(start, rotation=rotation, translation=-rotation @ center))
    return cameras
