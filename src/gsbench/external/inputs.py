"""Inputs of another program: the trial's training views, and of its test views the cameras alone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from gsbench.files import write_json
from gsbench.init.base import MODEL_FOLDER, PointCloud
from gsbench.scene.camera import Camera
from gsbench.scene.colmap import write_model
from gsbench.scene.names import check_picture_names, png_name
from gsbench.scene.types import View

IMAGES = "images"
TRANSFORMS = "transforms.json"
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenCV's camera axes (y down, z forward) to OpenGL's (y up, z backward)
FAST_PNG = 1  # zlib's level: files that live as long as one training


def write_training_views(folder: Path, views: Sequence[View], cloud: PointCloud) -> None:
    """Write ``views`` as a COLMAP folder: PNG files, PINHOLE cameras of their size, and ``cloud`` as its points.

    The points have no observations: which test views saw them, and where, stays here.
    """
    check_picture_names([view.name for view in views], folder / IMAGES)
    (folder / IMAGES).mkdir(parents=True)
    for view in views:
        Image.fromarray(view.image).save(folder / IMAGES / png_name(view.name), compress_level=FAST_PNG)
    write_model(folder / MODEL_FOLDER, _cameras(views), cloud=(cloud.points, cloud.colors))


def write_test_cameras(folder: Path, views: Sequence[View]) -> None:
    """Write the cameras of ``views`` and no pixel: a COLMAP model, and the same as nerfstudio's ``transforms.json``.

    Renders are expected under the names that stand there.
    """
    cameras = _cameras(views)
    write_model(folder / MODEL_FOLDER, cameras)
    write_json(folder / TRANSFORMS, {"camera_model": "OPENCV", "frames": [_frame(*item) for item in cameras.items()]})


def _cameras(views: Sequence[View]) -> dict[str, Camera]:
    return {png_name(view.name): view.camera for view in views}


def _frame(name: str, camera: Camera) -> dict[str, Any]:
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3], world_from_camera[:3, 3] = camera.rotation.T, camera.center
    intrinsics = {"w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy}
    pose = {"transform_matrix": (world_from_camera @ OPENGL).tolist()}
    return {"file_path": name} | intrinsics | {"cx": camera.cx, "cy": camera.cy} | pose
