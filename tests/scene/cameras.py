"""Cameras that look at a place, and those of a COLMAP model."""

import numpy as np

from gsbench.scene.colmap import pinhole_camera
from gsbench.scene.types import Camera


def looking(eye, target, up=(0.0, 0.0, 1.0), size=(64, 48), focal=60.0):
    """A camera at ``eye`` that looks at ``target``; x right, y down, z ahead."""
    ahead = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(ahead, up)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(ahead, right), ahead])
    width, height = size
    return Camera(width, height, focal, focal, width / 2, height / 2, rotation, -rotation @ eye)


def cameras_of(model):
    """The cameras of all registered images by name."""
    registered = [image for image in model.images.values() if image.has_pose]
    return {
        image.name: pinhole_camera(model.cameras[image.camera_id], image.cam_from_world())
        for image in registered
    }
