"""Folders of another program: what it is given (training views, test cameras alone), and what it leaves, checked."""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from gsbench.errors import InputError, TrainingError
from gsbench.eval.pictures import match_by_order, match_pictures
from gsbench.files import write_json
from gsbench.gaussians.model import Gaussians
from gsbench.gaussians.ply import read_ply
from gsbench.init.base import MODEL_FOLDER, PointCloud
from gsbench.scene.camera import Camera
from gsbench.scene.colmap import write_model
from gsbench.scene.images import read_image
from gsbench.scene.names import check_picture_names, png_name
from gsbench.scene.types import View
from gsbench.words import counted, some_of

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


def take_model(output: Path, pattern: str, target: Path) -> Gaussians:
    """The Gaussians of the one file below ``output`` that fits ``pattern``, copied to ``target``.

    Raises `TrainingError` where there is not exactly one, or where it is no sound 3DGS PLY.
    """
    files = _files(output, pattern)
    if len(files) > 1:
        raise TrainingError(
            f"{counted(len(files), 'file')} fit densify.result ({_named(files, output)}): it must name one"
        )
    try:
        gaussians = read_ply(files[0])
    except InputError as error:
        raise TrainingError(str(error)) from error
    shutil.copyfile(files[0], target)
    return gaussians


def take_renders(output: Path, pattern: str, by_order: bool, views: Sequence[View], target: Path) -> None:
    """The pictures below ``output`` that fit ``pattern``, as PNG files of the names of ``views`` in ``target``.

    Raises `TrainingError` where a view has none or several, or where one is damaged or of another size.
    """
    files = _files(output, pattern)
    names = [file.relative_to(output).as_posix() for file in files]
    wanted = [png_name(view.name) for view in views]
    target.mkdir()
    try:
        matching = match_by_order(wanted, names) if by_order else match_pictures(wanted, names, "densify.by_order=true")
        for name, view in zip(wanted, views, strict=True):
            picture = read_image(output / matching.pairs[name])  # [H, W, 3]
            (height, width), camera = picture.shape[:2], view.camera
            if (width, height) != (camera.width, camera.height):
                raise InputError(
                    f"{output / matching.pairs[name]} is {width}x{height} px and the view {camera.width}x"
                    f"{camera.height}: sizes are never changed here"
                )
            Image.fromarray(picture).save(target / name)
    except InputError as error:
        raise TrainingError(str(error)) from error


def _files(output: Path, pattern: str) -> list[Path]:
    """The files that fit ``pattern``, sorted; raises `TrainingError`, naming those that there are, for none."""
    files = sorted(path for path in output.glob(pattern) if path.is_file())
    if not files:
        there = sorted(path for path in output.rglob("*") if path.is_file())
        raise TrainingError(
            f"it left no {pattern} (densify.result); it wrote {_named(there, output) if there else 'no file'}"
        )
    return files


def _named(files: Sequence[Path], output: Path) -> str:
    return some_of([file.relative_to(output).as_posix() for file in files])
