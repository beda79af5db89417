"""Another program: its input folders (training views, test cameras) and its results."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from gsbench.errors import InputError, TrainingError
from gsbench.eval.pictures import Look, find_odd_pictures, look_at, read_picture
from gsbench.files import write_json
from gsbench.gaussians.model import Gaussians
from gsbench.gaussians.ply import read_ply, write_ply
from gsbench.init.base import MODEL_FOLDER, PointCloud
from gsbench.normalization import IDENTITY, Normalization
from gsbench.scene.colmap import write_model
from gsbench.scene.images import check_picture_names, png_name
from gsbench.scene.names import match_by_order, match_pictures
from gsbench.scene.types import Camera, View
from gsbench.words import counted, some_of

IMAGES = "images"
TRANSFORMS = "transforms.json"
# OpenCV's camera axes (y down, z forward) to OpenGL's (y up, z backward)
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
FAST_PNG = 1  # zlib level; the files are deleted after the training


def write_training_views(
    folder: Path, views: Sequence[View], cloud: PointCloud, normalization: Normalization = IDENTITY
) -> None:
    """Write ``views`` as a COLMAP folder: PNG files, PINHOLE cameras, and ``cloud`` as points.

    ``normalization`` is undone, so programs get the coordinates in which the scene was given. The
    points have no observations, because these would reveal what test views saw.
    """
    check_picture_names([view.name for view in views], folder / IMAGES)
    (folder / IMAGES).mkdir(parents=True)
    for view in views:
        target = folder / IMAGES / png_name(view.name)
        Image.fromarray(view.image).save(target, compress_level=FAST_PNG)
    points = cloud.points if normalization.is_identity else normalization.undo(cloud.points)
    write_model(folder / MODEL_FOLDER, _cameras(views, normalization), cloud=(points, cloud.colors))


def write_test_cameras(
    folder: Path, views: Sequence[View], normalization: Normalization = IDENTITY
) -> None:
    """Write the cameras of ``views`` as a COLMAP model and nerfstudio's ``transforms.json``.

    Renders are expected under the names in these files.
    """
    cameras = _cameras(views, normalization)
    write_model(folder / MODEL_FOLDER, cameras)
    frames = [_frame(name, camera) for name, camera in cameras.items()]
    write_json(folder / TRANSFORMS, {"camera_model": "OPENCV", "frames": frames})


def _cameras(views: Sequence[View], normalization: Normalization) -> dict[str, Camera]:
    return {png_name(view.name): view.camera.in_own_coordinates(normalization) for view in views}


def _frame(name: str, camera: Camera) -> dict[str, Any]:
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3], world_from_camera[:3, 3] = camera.rotation.T, camera.center
    return {
        "file_path": name,
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "transform_matrix": (world_from_camera @ OPENGL).tolist(),
    }


def collect_model(
    output: Path, pattern: str, target: Path, normalization: Normalization = IDENTITY
) -> Gaussians:
    """Write the model in the one file that fits ``pattern`` to ``target``, normalised; return it.

    Raises `TrainingError` if there is not exactly one such file, or if it is not a valid 3DGS PLY.
    """
    files = _files(output, pattern)
    # A program may leave a model for each checkpoint; a guess would measure the wrong one.
    if len(files) > 1:
        raise TrainingError(
            f"{counted(len(files), 'file')} fit densify.result ({_named(files, output)}): it must "
            "name one"
        )
    try:
        gaussians = read_ply(files[0], normalization=normalization)
    except InputError as error:
        raise TrainingError(str(error)) from error
    write_ply(gaussians, target)
    return gaussians


def collect_renders(
    output: Path, pattern: str, by_order: bool, views: Sequence[View], target: Path
) -> None:
    """Write the pictures that fit ``pattern`` to ``target``, as PNG files named after ``views``.

    Raises `TrainingError` if a view has no or several pictures, or if a picture is damaged or has
    another size.
    """
    files = _files(output, pattern)
    names = [file.relative_to(output).as_posix() for file in files]
    wanted = [png_name(view.name) for view in views]
    target.mkdir()
    try:
        if by_order:
            matching = match_by_order(wanted, names)
        else:
            matching = match_pictures(wanted, names, "densify.by_order=true")
        looks = [(name, look_at(output / matching.pairs[name]), Look()) for name in wanted]
        find_odd_pictures(looks, str(output))
        for name, view in zip(wanted, views, strict=True):
            picture = read_picture(output / matching.pairs[name], is_render=True)  # [H, W, 3]
            (height, width), camera = picture.shape[:2], view.camera
            if (width, height) != (camera.width, camera.height):
                raise InputError(
                    f"{output / matching.pairs[name]} is {width}x{height} px and the view "
                    f"{camera.width}x{camera.height}: sizes are never changed here"
                )
            Image.fromarray(picture).save(target / name)
    except InputError as error:
        raise TrainingError(str(error)) from error


def _files(output: Path, pattern: str) -> list[Path]:
    """The sorted files that fit ``pattern``; if none does, a `TrainingError` names the others."""
    files = sorted(path for path in output.glob(pattern) if path.is_file())
    if not files:
        existing = sorted(path for path in output.rglob("*") if path.is_file())
        raise TrainingError(
            f"it left no {pattern} (densify.result); it wrote "
            f"{_named(existing, output) if existing else 'no file'}"
        )
    return files


def _named(files: Sequence[Path], output: Path) -> str:
    return some_of([file.relative_to(output).as_posix() for file in files])
