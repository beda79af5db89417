"""The files of a COLMAP model: which there are, and whether binary ones are whole.

pycolmap trusts the counts that a binary file states: on a truncated or foreign file it may loop for minutes or read
nonsense. Walking the records first (layout: COLMAP's ``src/colmap/scene/reconstruction_io_binary.cc``) costs little and
finds that at once.
"""

from __future__ import annotations

import struct
from pathlib import Path

from gsbench.errors import InputError

REQUIRED = ("cameras", "images", "points3D")
OPTIONAL = ("rigs", "frames")  # since COLMAP 3.12

_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")  # id, model, width, height; then the parameters as doubles
_IMAGE = struct.Struct("<I7dI")  # id, quaternion, translation, camera id; then the name, zero-terminated
_FRAME = struct.Struct("<II7dI")  # id, rig id, pose; then the number of its images
_FRAME_DATA_BYTES = 16  # sensor type, sensor id, image id
_POINT2D_BYTES = 24  # x, y, id of the 3D point
_POINT3D_BYTES = 43  # id, position, colour, error
_TRACK_ELEMENT_BYTES = 8
# parameters of each camera model by its id: COLMAP's src/colmap/sensor/models.h
_PARAMETERS = {0: 3, 1: 4, 2: 4, 3: 5, 4: 8, 5: 8, 6: 12, 7: 5, 8: 4, 9: 5, 10: 12, 11: 16}


def model_files(folder: Path) -> list[Path]:
    """The files that make up the model in ``folder``: the binary ones if complete, else the text ones.

    Raises `InputError` if neither set is complete.
    """
    for suffix in (".bin", ".txt"):
        files = [folder / f"{stem}{suffix}" for stem in REQUIRED]
        if all(file.is_file() for file in files):
            return files + [file for stem in OPTIONAL if (file := folder / f"{stem}{suffix}").is_file()]
    raise InputError(f"{folder}: no COLMAP model here: expected cameras, images and points3D as .bin or .txt")


def check_binary_model(folder: Path) -> None:
    """Raise `InputError` if a binary file of the model is truncated or has bytes left over."""
    for stem, walk in _WALKS.items():
        file = folder / f"{stem}.bin"
        if stem in OPTIONAL and not file.is_file():
            continue
        data = file.read_bytes()
        try:
            (count,) = _COUNT.unpack_from(data)
            end = walk(data, count)
        except (struct.error, ValueError) as error:
            raise InputError(f"{file}: the file is truncated or damaged: copy or export it again") from error
        if end != len(data):
            surplus = "many" if end < len(data) else "few"
            raise InputError(f"{file}: {abs(len(data) - end)} bytes too {surplus}: copy or export it again")


def _walk_cameras(data: bytes, count: int) -> int:
    offset = _COUNT.size
    for _ in range(count):
        _, model, _, _ = _CAMERA.unpack_from(data, offset)
        if model not in _PARAMETERS:
            return len(data)  # a model newer than this table: pycolmap will know
        offset += _CAMERA.size + 8 * _PARAMETERS[model]
    return offset


def _walk_images(data: bytes, count: int) -> int:
    offset = _COUNT.size
    for _ in range(count):
        _IMAGE.unpack_from(data, offset)
        offset = data.index(b"\0", offset + _IMAGE.size) + 1
        (points,) = _COUNT.unpack_from(data, offset)
        offset += _COUNT.size + points * _POINT2D_BYTES
    return offset


def _walk_points(data: bytes, count: int) -> int:
    offset = _COUNT.size
    for _ in range(count):
        (track,) = _COUNT.unpack_from(data, offset + _POINT3D_BYTES)
        offset += _POINT3D_BYTES + _COUNT.size + track * _TRACK_ELEMENT_BYTES
    return offset


def _walk_frames(data: bytes, count: int) -> int:
    offset = _COUNT.size
    for _ in range(count):
        *_, images = _FRAME.unpack_from(data, offset)
        offset += _FRAME.size + images * _FRAME_DATA_BYTES
    return offset


_WALKS = {"cameras": _walk_cameras, "images": _walk_images, "points3D": _walk_points, "frames": _walk_frames}
