"""Outputs of another program: one model, or a picture of every test view; checked before anything is kept."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from gsbench.errors import InputError, TrainingError
from gsbench.eval.matching import match_by_order, match_pictures
from gsbench.gaussians.model import Gaussians
from gsbench.gaussians.ply import read_ply
from gsbench.scene.images import read_image
from gsbench.scene.names import png_name
from gsbench.scene.types import View
from gsbench.words import counted, some_of


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
