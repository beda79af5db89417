"""Reading COLMAP models safely: files are checked before pycolmap reads them, values after.

pycolmap trusts its files: on one that is cut it may read for minutes, it cuts names at a blank and
bytes of colours, and it accepts a NaN and a zero quaternion. Reading in a process of its own would
cost each trial more than half a second. Layouts: COLMAP's
``src/colmap/scene/reconstruction_io_binary.cc`` and ``reconstruction_io_text.cc``.
"""

import logging
import re
import struct
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pycolmap

from gsbench.errors import InputError
from gsbench.files import DAMAGE, GIT_LFS, LFS_REMEDY
from gsbench.parsing import one_line, without_byte_order_mark
from gsbench.scene.colmap_files import image_lines, model_files, text_lines

log = logging.getLogger(__name__)

MAX_SIDE = 1_000_000  # px
MAX_LENGTH = 1e6  # of a quaternion, whose least length is 1 / MAX_LENGTH
UNIT_TOLERANCE = 1e-9  # a quaternion whose length differs from 1 by no more is not normalised again

# A binary record: what stands before its list, the length of the list, and bytes of an entry. The
# name of an image, ended by a zero, comes before the length.
COUNT = struct.Struct("<Q")
BINARY = {
    "images": (struct.Struct("<I7dI"), COUNT, 24),  # id, pose, camera; x, y, id of the 3D point
    # id, place, colour, error; the ids of an image and of its 2D point
    "points3D": (struct.Struct("<Q3d3Bd"), COUNT, 8),
    "frames": (struct.Struct("<II7d"), struct.Struct("<I"), 16),  # id, rig, pose; data ids
}
NUMBER = r" [-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
BYTE = r" (?:25[0-5]|2[0-4]\d|1?\d?\d)"
# The lines of the text files, with one blank before each number, and what they are in words.
TEXT = {
    "cameras": (rf" \d+ \w+ \d+ \d+(?:{NUMBER})+", "id, model, whole px, parameters"),
    "images": (rf" \d+(?:{NUMBER}){{7}} \d+ \S.*", "id, pose, id of a camera, name"),
    "2D points": (
        rf"(?:{NUMBER}{NUMBER} -?\d+)* ?",
        "x, y, id of a 3D point for its 2D points (each image needs a second line for them, which "
        "may be empty)",
    ),
    "points3D": (
        rf" \d+(?:{NUMBER}){{3}}(?:{BYTE}){{3}} [-+.\w]+(?: \d+ \d+)*",
        "id, x, y, z, a colour of whole numbers from 0 to 255, error, pairs of ids",
    ),
}


def read_model(folder: Path) -> pycolmap.Reconstruction:
    """Read a COLMAP model, binary or text, with rigs and frames or in the older three files.

    Raises `InputError`, one line, if it is missing or damaged.
    """
    files, place = model_files(folder), folder
    try:
        for place in files:
            _check_file(place)
        place = folder
        try:
            model = _read(folder)
        except ValueError as error:
            # COLMAP requires that images and points name each other; files of two models do not.
            if "Check failed" not in str(error):
                raise
            model = _read(folder, bare=True)
            log.warning(
                "%s: images and points3D name each other differently, as files of two models do: "
                "points are read without the images that see them",
                folder,
            )
        _check_values(folder, model)
    except InputError as error:
        raise InputError(f"{place}: {error}") from error
    except UnicodeDecodeError as error:
        # not "export it again", which would write the same names
        name = bytes(error.object)[max(error.start - 20, 0) : error.end + 20]
        raise InputError(
            f"{place}: a name is not UTF-8 ({str(name)[2:-1]}): rename the photographs to ASCII, "
            "and make the model again"
        ) from error
    except DAMAGE as error:
        reason = one_line(str(error)) or type(error).__name__
        raise InputError(
            f"{place}: the COLMAP model cannot be read ({reason}): copy or export it again"
        ) from error
    return model


def _check_file(file: Path) -> None:
    """Raise an error for a file that is cut or too long, or has a line of another form."""
    data = file.read_bytes()
    if data.startswith(GIT_LFS):
        raise InputError(LFS_REMEDY)
    if file.suffix == ".bin":
        records = list(_records(file.stem, data)) if file.stem in BINARY else []
        if file.stem == "points3D":
            places = b"".join(data[start + 8 : start + 32] for start, _ in records)
            if not np.isfinite(np.frombuffer(places)).all():
                raise ValueError("a point has no finite position")
        return
    if file.stem == "images":
        pairs = image_lines(file)
        _check_lines("images", [line for line, _ in pairs])
        _check_lines("2D points", [points for _, points in pairs])
    else:
        _check_lines(file.stem, list(filter(None, text_lines(file))))


def _records(stem: str, data: bytes) -> Iterator[tuple[int, int]]:
    """Yield the offsets of each record of a binary file and of its list."""
    head, length, entry = BINARY[stem]
    (count,), offset = COUNT.unpack_from(data), COUNT.size
    for _ in range(count):
        end = offset + head.size
        if stem == "images":
            end = data.index(b"\0", end) + 1
        yield offset, end
        offset = end + length.size + length.unpack_from(data, end)[0] * entry
    _check_end(data, offset)


def _check_end(data: bytes, end: int) -> None:
    if end != len(data):
        extra = len(data) - end
        raise ValueError(f"{abs(extra)} bytes too {'many' if extra > 0 else 'few'}")


def _check_lines(kind: str, lines: list[str]) -> None:
    pattern, wanted = TEXT.get(kind, (".*", ""))
    for line in lines:
        words = " ".join(["", *line.split()])
        if not re.fullmatch(pattern, words):
            raise InputError(f"a line must be {wanted}, with decimal points, not {words[1:80]!r}")


def _read(folder: Path, bare: bool = False) -> pycolmap.Reconstruction:
    """Read a model that has been checked; ``bare`` leaves out 2D points and tracks."""
    files = model_files(folder)
    is_text = files[0].suffix == ".txt"
    if not is_text and not bare:
        return pycolmap.Reconstruction(folder)
    with tempfile.TemporaryDirectory() as copy:
        for file in files:
            (Path(copy) / file.name).write_bytes(_content(file, bare))
        model = pycolmap.Reconstruction(copy)
    if is_text:  # pycolmap cuts names at a blank
        for line, _ in image_lines(folder / "images.txt"):
            words = line.split(maxsplit=9)
            model.images[int(words[0])].name = words[9]
    return model


def _content(file: Path, bare: bool) -> bytes:
    """The content of a sound file without a byte order mark, which pycolmap takes for a record."""
    data = file.read_bytes()
    if file.suffix == ".txt":
        data = without_byte_order_mark(data)
    if not bare or file.stem not in ("images", "points3D"):
        return data
    if file.suffix == ".bin":
        kept = [data[start:end] + COUNT.pack(0) for start, end in _records(file.stem, data)]
        return data[: COUNT.size] + b"".join(kept)
    if file.stem == "images":
        lines = [f"{line}\n" for line, _ in image_lines(file)]
    else:
        lines = [" ".join(line.split()[:8]) for line in text_lines(file)]
    return "\n".join([*lines, ""]).encode()


def _check_values(folder: Path, model: pycolmap.Reconstruction) -> None:
    """Raise ValueError for values that no model can have, and give quaternions unit length."""
    for number, camera in model.cameras.items():
        focal = [camera.params[place] for place in camera.focal_length_idxs()]
        is_size = max(camera.width, camera.height) <= MAX_SIDE and camera.width * camera.height > 0
        if not is_size or not np.isfinite(camera.params).all() or min(focal, default=1) <= 0:
            size = f"{camera.width}x{camera.height} px"
            raise ValueError(f"camera {number} is damaged ({size}, {list(camera.params)})")
    names = [image.name for image in model.images.values()]
    if len(set(names)) < len(names) or "" in names:
        raise ValueError("images have no names of their own")
    # COLMAP normalises only the quaternions of images.
    for number, rig in model.rigs.items():
        for sensor, pose in rig.non_ref_sensors.items():
            if pose is not None:
                _normalize(pose, f"a sensor of rig {number}")
                rig.set_sensor_from_rig(sensor, pose)
    for number, frame in model.frames.items():
        if frame.has_pose():
            _normalize(frame.rig_from_world, f"frame {number}")
    for image in model.images.values():
        if image.has_pose and not np.isfinite(image.cam_from_world().matrix()).all():
            raise ValueError(f"image {image.name} has no finite pose")
    # pycolmap does not see that these files are cut
    poses = [pose for rig in model.rigs.values() for pose in rig.non_ref_sensors.values()]
    sizes = {
        "cameras.bin": sum(24 + 8 * len(camera.params) for camera in model.cameras.values()),
        "rigs.bin": sum(8 + 8 * min(rig.num_sensors(), 1) for rig in model.rigs.values())
        + sum(9 if pose is None else 65 for pose in poses),
    }
    for name, size in sizes.items():
        if (folder / name) in model_files(folder):
            _check_end((folder / name).read_bytes(), COUNT.size + size)


def _normalize(pose: pycolmap.Rigid3d, owner: str) -> None:
    """Give a rotation unit length unless it has."""
    length = pose.rotation.norm()
    if not 1 / MAX_LENGTH < length < MAX_LENGTH:
        raise ValueError(f"{owner} has no pose that can be used")
    if abs(length - 1) > UNIT_TOLERANCE:
        pose.rotation.normalize()
