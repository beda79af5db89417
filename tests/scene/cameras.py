"""Cameras that look at a place, and those of a COLMAP model."""

from __future__ import annotations

import numpy as np
import pycolmap

from gsbench.scene.colmap import pinhole_camera
from gsbench.scene.types import Camera


def looking(
    eye: np.ndarray,
    target: np.ndarray,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
    size: tuple[int, int] = (64, 48),
    focal: float = 60.0,
) -> Camera:
    """A camera at ``eye`` that looks at ``target``; x right, y down, z ahead."""
    ahead = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(ahead, up)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(ahead, right), ahead])
    width, height = size
    return Camera(width, height, focal, focal, width / 2, height / 2, rotation, -rotation @ eye)


def cameras_of(model: pycolmap.Reconstruction) -> dict[str, Camera]:
    """The cameras of all registered images by name."""
    registered = [image for image in model.images.values() if image.has_pose]
    return {
        image.name: pinhole_camera(model.cameras[image.camera_id], image.cam_from_world())
        for image in registered
    }
