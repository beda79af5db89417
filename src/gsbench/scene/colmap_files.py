"""Finding the files of a COLMAP model and checking their records before pycolmap reads them.

pycolmap trusts its files: on a truncated or foreign file it may loop for minutes or read nonsense,
and it accepts a zero quaternion or a NaN without an error. Checking the records first costs little
and finds such files at once. Layouts: COLMAP's ``src/colmap/scene/reconstruction_io_binary.cc`` and
``reconstruction_io_text.cc``.
"""

from __future__ import annotations

import math
import re
import shutil
import struct
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from gsbench.errors import InputError
from gsbench.files import GIT_LFS, LFS_REMEDY
from gsbench.parsing import one_line, without_byte_order_mark
from gsbench.scene.colmap_checks import (
    MODELS,
    NEARLY,
    PARAMETERS,
    ModelChecks,
    NamesError,
    NamesOnly,
)
from gsbench.words import counted

REQUIRED = ("cameras", "images", "points3D")
OPTIONAL = ("rigs", "frames")  # since COLMAP 3.12

_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")  # id, model, width, height; then the parameters as doubles
# id, quaternion, translation, camera id; then the name, zero-terminated
_IMAGE = struct.Struct("<I7dI")
_RIG = struct.Struct("<II")  # id, number of sensors
_SENSOR = struct.Struct("<iI")  # type, id
_POSE = struct.Struct("<7d")
_FRAME = struct.Struct("<II7dI")  # id, rig id, pose, number of images
_FRAME_DATA_BYTES = 16  # sensor type, sensor id, image id
_POINT2D_BYTES = 24  # x, y, id of the 3D point
_POINT3D = struct.Struct("<Q3d3Bd")  # id, position, colour, error; then the length of the track
_TRACK_ELEMENT = struct.Struct("<II")  # image id, index of the 2D point


def model_files(folder: Path) -> list[Path]:
    """The files of the model in ``folder``: the binary files if complete, else the text files.

    Raises `InputError` if neither set is complete.
    """
    lacking_by_suffix = {
        suffix: [
            f"{stem}{suffix}" for stem in REQUIRED if not (folder / f"{stem}{suffix}").is_file()
        ]
        for suffix in (".bin", ".txt")
    }
    for suffix, lacking in lacking_by_suffix.items():
        if not lacking:
            files = [folder / f"{stem}{suffix}" for stem in (*REQUIRED, *OPTIONAL)]
            return [file for file in files if file.is_file()]
    for lacking in lacking_by_suffix.values():
        if len(lacking) < len(REQUIRED):
            hint = "; points3D.txt may be empty" if lacking == ["points3D.txt"] else ""
            raise InputError(
                f"{folder}: the COLMAP model is not complete: add {' and '.join(lacking)}{hint}"
            )
    raise InputError(
        f"{folder}: no COLMAP model here: expected cameras, images and points3D as .bin or .txt"
    )


def has_both_forms(folder: Path) -> bool:
    """Return whether a complete binary model has a text model beside it, which is not read."""
    is_text = (folder / "images.txt").is_file()
    return is_text and model_files(folder)[0].suffix == ".bin"


def check_model(folder: Path) -> None:
    """Raise `InputError`, one line, for a file that is cut, too long or has impossible values."""
    checks = ModelChecks()
    for file in model_files(folder):  # in this order: images refer to cameras, points to images
        binary_record, text_record = _RECORDS[file.stem]
        try:
            with file.open("rb") as stream:
                if stream.read(len(GIT_LFS)) == GIT_LFS:
                    raise NamesError(LFS_REMEDY)
            if file.suffix == ".bin":
                _walk_binary(file, binary_record, checks)
            else:
                _walk_text(file, text_record, checks)
        except (struct.error, ValueError, IndexError, OverflowError) as error:
            if isinstance(error, NamesError):
                raise InputError(f"{file}: {error}") from error
            if isinstance(error, InputError):  # a ValueError that already says what is wrong
                raise InputError(f"{file}: {error}: copy or export it again") from error
            raise InputError(
                f"{file}: the file is truncated or damaged: copy or export it again"
            ) from error
        except OSError as error:
            raise InputError(f"{file}: cannot be read ({error.strerror})") from error


def write_without_tracks(folder: Path, target: Path) -> None:
    """Write the model of ``folder`` without 2D points and tracks, for files that disagree."""
    for file in model_files(folder):
        if file.stem not in ("images", "points3D"):
            shutil.copyfile(file, target / file.name)
        elif file.suffix == ".bin":
            (target / file.name).write_bytes(_bare(file.read_bytes(), file.stem == "images"))
        else:
            text = without_byte_order_mark(file.read_bytes()).decode()
            rows = [line for line in text.split("\n") if not line.lstrip().startswith("#")]
            if file.stem == "images":  # a line of 2D points may be empty
                kept = [f"{rows[at]}\n" for at in range(0, len(rows), 2) if rows[at].strip()]
            else:
                kept = [" ".join(row.split()[:8]) for row in rows if row.strip()]
            (target / file.name).write_text("".join(f"{line}\n" for line in kept), "utf-8")


def _bare(data: bytes, of_images: bool) -> bytes:
    """The records of a sound images.bin or points3D.bin, each with an empty list at its end."""
    kept, offset = [data[: _COUNT.size]], _COUNT.size
    while offset < len(data):
        if of_images:
            end, size = data.index(b"\0", offset + _IMAGE.size) + 1, _POINT2D_BYTES
        else:
            end, size = offset + _POINT3D.size, _TRACK_ELEMENT.size
        kept += [data[offset:end], _COUNT.pack(0)]
        offset = end + _COUNT.size + _COUNT.unpack_from(data, end)[0] * size
    return b"".join(kept)


def _walk_binary(
    file: Path, record: Callable[[bytes, int, ModelChecks], int], checks: ModelChecks
) -> None:
    """Check a binary file; ``record`` checks a record at an offset and returns the next offset."""
    data = file.read_bytes()
    (count,) = _COUNT.unpack_from(data)
    offset = _COUNT.size
    for _ in range(count):
        offset = record(data, offset, checks)
        if offset > len(data):
            break
    if offset != len(data):
        raise InputError(
            f"{abs(len(data) - offset)} bytes too {'many' if offset < len(data) else 'few'}"
        )


def _binary_camera(data: bytes, offset: int, checks: ModelChecks) -> int:
    camera_id, model, width, height = _CAMERA.unpack_from(data, offset)
    if model not in MODELS:
        raise InputError(f"camera {camera_id} is of an unknown model ({model})")
    name, length = MODELS[model]
    params = struct.unpack_from(f"<{length}d", data, offset + _CAMERA.size)
    checks.camera(camera_id, name, width, height, params)
    return offset + _CAMERA.size + 8 * length


def _binary_image(data: bytes, offset: int, checks: ModelChecks) -> int:
    image_id, *pose, camera_id = _IMAGE.unpack_from(data, offset)
    end = data.index(b"\0", offset + _IMAGE.size)
    name = _decoded(data[offset + _IMAGE.size : end], f"the name of image {image_id}")
    (points,) = _COUNT.unpack_from(data, end + 1)
    checks.image(image_id, pose, camera_id, name, points)
    return end + 1 + _COUNT.size + points * _POINT2D_BYTES


def _decoded(content: bytes, what: str) -> str:
    try:
        return content.decode()
    except UnicodeDecodeError as error:
        # not "copy or export it again", which would write the same names
        raise NamesError(
            f"{what} is not UTF-8 ({one_line(str(content)[2:-1])}): rename the photographs to "
            "ASCII, and make the model again"
        ) from error


def _binary_point(data: bytes, offset: int, checks: ModelChecks) -> int:
    point_id, x, y, z, *_ = _POINT3D.unpack_from(data, offset)
    (length,) = _COUNT.unpack_from(data, offset + _POINT3D.size)
    start = offset + _POINT3D.size + _COUNT.size
    end = start + length * _TRACK_ELEMENT.size
    if end <= len(data):
        checks.point(point_id, (x, y, z), _TRACK_ELEMENT.iter_unpack(data[start:end]))
    return end


def _binary_frame(data: bytes, offset: int, checks: ModelChecks) -> int:
    frame_id, _, *pose, images = _FRAME.unpack_from(data, offset)
    checks.pose(f"frame {frame_id}", pose)
    return offset + _FRAME.size + images * _FRAME_DATA_BYTES


def _binary_rig(data: bytes, offset: int, checks: ModelChecks) -> int:
    rig_id, sensors = _RIG.unpack_from(data, offset)
    # the first sensor is the reference, without a pose
    offset += _RIG.size + (_SENSOR.size if sensors else 0)
    for _ in range(1, sensors):
        (has_pose,) = struct.unpack_from("<B", data, offset + _SENSOR.size)
        offset += _SENSOR.size + 1
        if has_pose:
            checks.pose(f"a sensor of rig {rig_id}", _POSE.unpack_from(data, offset))
            offset += _POSE.size
    return offset


Lines = Iterator[str]
DECIMAL_COMMA = re.compile(r"(?:^|(?<=\s))-?\d+,\d+(?=\s|$)", re.MULTILINE)


def _walk_text(
    file: Path, record: Callable[[str, Lines, ModelChecks], None], checks: ModelChecks
) -> None:
    """Check a text file without comments; ``record`` gets a line and an iterator of later lines."""
    content = without_byte_order_mark(file.read_bytes())
    try:
        text = content.decode()
    except UnicodeDecodeError as error:
        number = content.count(b"\n", 0, error.start)
        damaged = content.split(b"\n")[number].strip()
        if file.stem == "images" and len(damaged.split()) >= 10:  # numbers and a name
            _decoded(damaged, f"line {number + 1}")
        raise InputError(f"line {number + 1} is not UTF-8") from error
    lines = (line.strip() for line in text.split("\n") if not line.lstrip().startswith("#"))
    try:
        for line in filter(None, lines):
            record(line, lines, checks)
    except ValueError as error:
        if comma := DECIMAL_COMMA.search(text):
            raise InputError(
                f"it has decimal commas ({comma[0].strip()}), where COLMAP writes points"
            ) from error
        raise


def text_names(folder: Path) -> dict[int, str]:
    """The names of the images of a text model by id, with the blanks that they may contain."""
    checks = NamesOnly()
    _walk_text(folder / "images.txt", _text_image, checks)
    return checks.names


def count_images(folder: Path) -> int:
    """The number of posed images of the model in ``folder``; raises `InputError` if unreadable."""
    file = next(file for file in model_files(folder) if file.stem == "images")
    try:
        if file.suffix == ".txt":
            return len(text_names(folder))
        with file.open("rb") as stream:
            (count,) = _COUNT.unpack(stream.read(_COUNT.size))
    except (struct.error, ValueError, IndexError, OSError) as error:
        raise InputError(
            f"{file}: its images cannot be counted: export it again, or set scene.sparse"
        ) from error
    return int(count)


def _numbers(words: Sequence[str]) -> list[float]:
    return [float(word) for word in words]


def _text_camera(line: str, _: Lines, checks: ModelChecks) -> None:
    words = line.split()
    if PARAMETERS.get(words[1]) != len(words) - 4:
        raise InputError(f"camera {words[0]} is of an unknown model or lacks parameters")
    for word in words[2:4]:
        said = f"camera {words[0]} has the size {word}: write whole numbers of px, without a point"
        _require_whole(word, said)
    checks.camera(int(words[0]), words[1], int(words[2]), int(words[3]), _numbers(words[4:]))


def _require_whole(word: str, said: str) -> None:
    """Raise `NamesError` for a number that is not written as a whole one."""
    if not float(word).is_integer() or not word.lstrip("-").isdecimal():
        raise NamesError(said)


def _text_image(line: str, lines: Lines, checks: ModelChecks) -> None:
    words = line.split(maxsplit=9)  # the name comes last, and may contain blanks
    # the line after an image holds its 2D points, and may be empty
    following = next(lines, "")
    points = following.split()
    if _is_image_line(following):
        raise NamesError(
            f"image {words[0]} has no line of 2D points: each image needs a second line, which may "
            "be empty"
        )
    if len(words) < 10 or len(points) % 3 or not all(map(math.isfinite, _numbers(points))):
        raise InputError(f"image {words[0]} lacks numbers")
    checks.image(int(words[0]), _numbers(words[1:8]), int(words[8]), words[9], len(points) // 3)


def _is_image_line(line: str) -> bool:
    """Return whether a line has an image's numbers and a name, and is no line of 2D points."""
    words = line.split(maxsplit=9)
    if len(words) < 10 or not (words[0].isdecimal() and words[8].isdecimal()):
        return False
    try:
        quaternion = _numbers(words[1:8])[:4]
        _numbers(words[9].split())
    except ValueError:  # a name that is no number
        return True
    # Of 2D points, the third number is an id or -1; of a quaternion, numbers have length 1.
    return len(line.split()) % 3 != 0 and abs(math.hypot(*quaternion) - 1) < NEARLY


def _text_point(line: str, _: Lines, checks: ModelChecks) -> None:
    words = line.split()
    for word in words[4:7]:
        said = f"point {words[0]} has the colour {word}: colours are whole numbers, 0 to 255"
        _require_whole(word, said)
    track = [int(word) for word in words[8:]]
    if len(words) < 8 or len(track) % 2 or not all(0 <= int(word) <= 255 for word in words[4:7]):
        raise InputError(f"point {words[0]} lacks numbers or has no colour")
    x, y, z, _error = _numbers([*words[1:4], words[7]])
    checks.point(int(words[0]), (x, y, z), zip(track[::2], track[1::2], strict=True))


def _text_rig(line: str, _: Lines, checks: ModelChecks) -> None:
    words = line.split()
    at = 4
    for _sensor in range(1, int(words[1])):
        has_pose = int(words[at + 2])
        if has_pose:
            checks.pose(f"a sensor of rig {words[0]}", _numbers(words[at + 3 : at + 10]))
        at += 10 if has_pose else 3


def _text_frame(line: str, _: Lines, checks: ModelChecks) -> None:
    words = line.split()
    checks.pose(f"frame {words[0]}", _numbers(words[2:9]))


_RECORDS = {
    "cameras": (_binary_camera, _text_camera),
    "images": (_binary_image, _text_image),
    "points3D": (_binary_point, _text_point),
    "rigs": (_binary_rig, _text_rig),
    "frames": (_binary_frame, _text_frame),
}


# the usual places, for messages; `find_model` searches numbered folders too
SPARSE_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0")


def missing_model(name: str, root: Path, sparse: str | None) -> str:
    """The message that ``root`` of the scene ``name`` has no COLMAP model, or "" if it has one."""
    try:
        find_model(root, sparse)
    except InputError as error:
        return f"scene {name}: {error}"
    return ""


def require_subfolder(root: Path, folder: str, key: str) -> Path:
    """The folder below ``root`` that the setting ``key`` names; raises `InputError` without it."""
    path = root / folder
    if not path.is_dir():
        existing = sorted(
            entry.name
            for entry in root.iterdir()
            if entry.is_dir() and not _is_model(entry) and not _is_model(entry / "0")
        )
        raise InputError(
            f"{path}: no such folder; set {key} to one of: "
            f"{', '.join(existing) or '(there is no folder)'}"
        )
    return path


def find_model(root: Path, sparse: str | None) -> tuple[Path, list[str]]:
    """The folder of the COLMAP model, and the others found, each with its number of images.

    COLMAP writes a folder sparse/0, sparse/1, … for each part that it could not connect, in no
    order of size. The model with the most images is taken, and of equal ones the first.
    """
    if sparse is not None:
        model_files(root / sparse)
        return root / sparse, []
    for parent in (root / "sparse", root / "colmap" / "sparse"):
        numbered = [folder for folder in parent.glob("*") if folder.name.isdecimal()]
        ordered = [*sorted(numbered, key=lambda path: int(path.name)), parent]
        found = [folder for folder in ordered if _is_model(folder)]
        if len(found) == 1:
            return found[0], []  # not counted: a damaged one gets a better message later
        if found:
            counts = {folder: count_images(folder) for folder in found}
            largest = max(found, key=counts.__getitem__)
            del counts[largest]
            return largest, [
                f"{path.relative_to(root)}: {counted(count, 'image')}"
                for path, count in counts.items()
            ]
    for folder in (root / name for name in SPARSE_FOLDERS):
        if any((folder / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt")):
            model_files(folder)  # its error names what the model lacks
    raise InputError(
        f"{root}: no COLMAP model in {' or '.join(SPARSE_FOLDERS)}: {_where_a_model_is(root)}"
    )


def _where_a_model_is(root: Path) -> str:
    """The setting that finds a model near ``root``; without one, advice to make it."""
    folders = [root, *(place for pattern in ("*", "*/*", "*/*/*") for place in root.glob(pattern))]
    folders += [root.parent / name for name in SPARSE_FOLDERS]
    model = next((place for place in folders if place.is_dir() and _is_model(place)), None)
    if model is None:
        why = "a database holds no poses: " if any(root.glob("*.db")) else ""
        return f"{why}make one with COLMAP, or use scene=photos"
    base = next((place for place in model.parents if (place / "images").is_dir()), root)
    setting = f"path={base}" if base != root else f"sparse={model.relative_to(root)}"
    return f"{model} is one: set scene.{setting}"


def _is_model(folder: Path) -> bool:
    try:
        return bool(model_files(folder))
    except InputError:
        return False
