"""Another program: its input folder of training views, and its model."""

from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from gsbench.errors import InputError, TrainingError
from gsbench.gaussians.model import Gaussians
from gsbench.gaussians.ply import read_ply, write_ply
from gsbench.init.base import MODEL_FOLDER, PointCloud
from gsbench.normalization import IDENTITY, Normalization
from gsbench.scene.colmap import write_model
from gsbench.scene.images import check_picture_names, png_name
from gsbench.scene.types import View
from gsbench.words import counted, some_of

IMAGES = "images"
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
    cameras = {png_name(view.name): view.camera.in_own_coordinates(normalization) for view in views}
    write_model(folder / MODEL_FOLDER, cameras, cloud=(points, cloud.colors))


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
