"""Videos: cameras along a path (nerfstudio's file, or made from a trial's cameras), and their pictures as a file.

The MP4 holds VP9, which browsers and players know, since the encoder of H.264 that wheels bring (x264, in those of
PyAV and imageio-ffmpeg) is under the GPL; the FFmpeg in OpenCV's wheels is under the LGPL, without it.
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from annotated_types import Len
from numpy.typing import NDArray
from PIL import Image
from scipy.interpolate import CubicSpline

from gsbench.errors import InputError
from gsbench.files import atomic, place_of
from gsbench.parsing import resolved
from gsbench.records import Number, Part, read_typed
from gsbench.scene.camera import Camera
from gsbench.scene.hold_out import arrange, looked_at, scene_up
from gsbench.scene.transforms import OPENGL, Matrix, Undo, rotation_of
from gsbench.system.install import install_command

Picture = NDArray[np.uint8]
Array = NDArray[np.float64]
T = TypeVar("T")

SUFFIXES = (".mp4", ".webp", ".gif")
PACKAGE, EXTRA = "cv2", "video"
CODEC = "vp09"
WEBP_QUALITY = 80  # Pillow's default
GIF_STEP = 10  # ms: GIF counts in hundredths of a second
REACH = 0.95  # quantile of the cameras' places along an axis of the ellipse, which outliers do not stretch
MAX_SIDE, MAX_FRAMES = 8192, 36_000  # px; 20 minutes at 30 frames a second
MIN_FPS, MAX_FPS = 1.0, 240.0
KEYS = 16  # places that a smooth way goes through: more would follow each step aside of who took the photographs
STEEP = 1e-3  # sine of the angle to the vertical, below which no picture has an upper side


def has_mp4() -> bool:
    """Return whether MP4 can be written here."""
    return importlib.util.find_spec(PACKAGE) is not None


def check_file(file: Path) -> None:
    """Raise InputError for a video file that cannot be written here."""
    if file.suffix.lower() not in SUFFIXES:
        raise InputError(f"--out {file}: a video ends with {', '.join(SUFFIXES)}")
    if file.suffix.lower() == ".mp4" and not has_mp4():
        raise InputError(f"--out {file}: MP4 needs OpenCV: {install_command(EXTRA)}; or name a file .webp or .gif")
    if file.is_dir():
        raise InputError(f"--out {file} is a folder: name the file to write")


def write_video(file: Path, pictures: Iterable[Picture], fps: float) -> None:
    """Write ``pictures``, [H, W, 3] uint8 of one size each, at ``fps`` a second; an animation repeats for ever.

    Raises InputError where the file cannot be written.
    """
    check_file(file)
    with place_of(file), atomic(file, sync=False) as temporary:
        if file.suffix.lower() == ".mp4":
            named = temporary.with_suffix(".mp4")  # OpenCV goes by the name
            try:
                _write_mp4(named, pictures, fps)
                named.replace(temporary)
            finally:
                named.unlink(missing_ok=True)
        else:
            _write_animation(temporary, file.suffix.lower(), pictures, fps)


def _write_mp4(file: Path, pictures: Iterable[Picture], fps: float) -> None:
    import cv2

    writer = None
    for picture in pictures:
        if writer is None:
            height, width = picture.shape[:2]
            writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*CODEC), fps, (width, height))
            if not writer.isOpened():
                raise OSError(f"this OpenCV writes no {CODEC}")
        writer.write(np.ascontiguousarray(picture[..., ::-1]))
    if writer is not None:
        writer.release()


def _write_animation(file: Path, suffix: str, pictures: Iterable[Picture], fps: float) -> None:
    frames: Iterator[Image.Image] = (Image.fromarray(picture) for picture in pictures)
    options: dict[str, Any] = {"format": suffix[1:].upper(), "save_all": True, "append_images": frames, "loop": 0}
    duration = 1000 / fps  # ms
    if suffix == ".gif":
        options["duration"] = max(2, round(duration / GIF_STEP)) * GIF_STEP  # browsers slow down what is quicker
    else:
        options |= {"duration": round(duration), "quality": WEBP_QUALITY}
    next(frames).save(file, **options)


@dataclass(frozen=True, kw_only=True)
class PathFrame(Part):
    """A camera of nerfstudio's path: camera to world in OpenGL's axes, row by row; the vertical angle in degrees."""

    camera_to_world: Annotated[list[Number], Len(16, 16)]
    fov: Number
    aspect: Number | None = None


@dataclass(frozen=True, kw_only=True)
class CameraPathRecord(Part):
    """The file that nerfstudio's viewer exports."""

    camera_path: Annotated[list[PathFrame], Len(1, MAX_FRAMES)]
    render_width: Number
    render_height: Number
    fps: Number | None = None
    camera_type: str = "perspective"


@dataclass(frozen=True, kw_only=True)
class DataparserTransforms(Part):
    """nerfstudio's ``dataparser_transforms.json``: what was done to the coordinates of the original data."""

    transform: Matrix
    scale: Number


@dataclass(frozen=True)
class CameraPath:
    """Cameras, one for each frame; ``fps`` where the file says it."""

    cameras: list[Camera] = field(repr=False)
    fps: float | None = None


def read_camera_path(path: Path, transforms: Path | None = None, size: tuple[int, int] | None = None) -> CameraPath:
    """Read nerfstudio's file of a camera path; ``size`` (width, height) in px instead of the file's.

    nerfstudio turns and scales a scene before it trains; ``transforms`` is the ``dataparser_transforms.json`` of that
    training, which takes the path back to the coordinates of the data. Raises InputError naming what is wrong.
    """
    record = _read(path, CameraPathRecord)
    if record.camera_type.lower() != "perspective":
        raise InputError(f"{path}: camera_type {record.camera_type} is not rendered here, perspective is")
    if record.fps is not None and not MIN_FPS <= record.fps <= MAX_FPS:
        raise InputError(f"{path}: fps must be from {MIN_FPS:g} to {MAX_FPS:g}, got {record.fps:g}: mend it")
    width, height = size or (_side(path, record.render_width), _side(path, record.render_height))
    undo = Undo() if transforms is None else _undo(transforms)
    cameras = []
    for place, frame in enumerate(record.camera_path):
        what = f"{path}: camera_to_world of frame {place}"
        matrix = np.array(frame.camera_to_world).reshape(4, 4)
        if not 0 < frame.fov < 180:
            raise InputError(f"{path}: fov of frame {place} must be between 0 and 180 degrees, got {frame.fov}")
        world_from_camera = undo.rotation.T @ rotation_of(matrix[:3, :3], what) @ OPENGL
        focal = height / (2 * math.tan(math.radians(frame.fov) / 2))
        cameras.append(_camera(width, height, focal, focal, world_from_camera, undo.points(matrix[None, :3, 3])[0]))
    return CameraPath(cameras, record.fps)


def through(cameras: Sequence[Camera], like: Camera, frames: int) -> list[Camera]:
    """``frames`` cameras with the picture of ``like`` on a smooth way along ``cameras``, where the photographs stand.

    A cubic spline through the means of up to `KEYS` groups of neighbours, in the order of
    `gsbench.scene.hold_out.arrange`, at a steady pace; it looks where the groups look.
    """
    order = arrange(cameras).order
    groups = np.array_split(np.array(order), min(KEYS, len(order)))
    centers = np.stack([np.mean([cameras[k].center for k in group], axis=0) for group in groups])  # [K, 3]
    ahead = np.stack([np.mean([cameras[k].rotation[2] for k in group], axis=0) for group in groups])  # [K, 3]
    up = scene_up(cameras, np.stack([camera.center for camera in cameras]))
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    pace = np.concatenate([[0.0], np.cumsum(steps + 1e-6 * (steps.sum() or 1.0))])  # increasing, where places agree too
    along = np.linspace(0, pace[-1], frames)
    places, sights = CubicSpline(pace, centers)(along), CubicSpline(pace, ahead)(along)  # [F, 3] each
    return [_looking(like, center, sight, up) for center, sight in zip(places, sights, strict=True)]


def ellipse(cameras: Sequence[Camera], like: Camera, frames: int) -> list[Camera]:
    """``frames`` cameras with the picture of ``like`` on an ellipse, which looks where ``cameras`` look.

    It lies in the plane in which the cameras spread most, and its axes span the places of `REACH` of them from either
    side. It ends one step before its beginning, so that a video of it can be repeated.
    """
    centers = np.stack([camera.center for camera in cameras])  # [V, 3]
    up, target = scene_up(cameras, centers), looked_at(cameras, centers)
    middle = centers.mean(axis=0)
    _, _, directions = np.linalg.svd(centers - middle, full_matrices=True)  # [3, 3], those of largest spread first
    plane = directions[:2]
    if np.dot(np.cross(*plane), up) < 0:
        plane = plane * [[1], [-1]]  # seen from above, always the same way round
    low, high = np.quantile((centers - middle) @ plane.T, [1 - REACH, REACH], axis=0)  # [2] each
    middle = middle + (low + high) / 2 @ plane
    ahead = np.mean([camera.rotation[2] for camera in cameras], axis=0)
    found = []
    for angle in 2 * np.pi * np.arange(frames) / frames:
        center = middle + (high - low) / 2 * [math.cos(angle), math.sin(angle)] @ plane
        found.append(_looking(like, center, ahead if target is None else target - center, up))
    return found


def _looking(like: Camera, center: Array, ahead: Array, up: Array) -> Camera:
    """The camera at ``center`` [3] that looks along ``ahead`` [3], with ``up`` [3] upwards in its picture."""
    right = np.cross(ahead, up)
    length = float(np.linalg.norm(right))
    if length < STEEP * float(np.linalg.norm(ahead)) or length == 0:
        raise InputError("this way through the cameras looks straight up or down: give a camera path (--path)")
    forward, right = ahead / np.linalg.norm(ahead), right / length
    axes = np.column_stack([right, np.cross(forward, right), forward])  # x right, y down, z ahead
    return _camera(like.width, like.height, like.fx, like.fy, axes, center)


def _camera(width: int, height: int, fx: float, fy: float, world_from_camera: Array, center: Array) -> Camera:
    rotation = world_from_camera.T
    return Camera(width, height, fx, fy, width / 2, height / 2, rotation, -rotation @ center)


def _undo(path: Path) -> Undo:
    record = _read(path, DataparserTransforms)
    if not record.scale > 0:
        raise InputError(f"{path}: scale must be positive, got {record.scale}")
    matrix = np.array(record.transform[:3])  # [3, 4]
    return Undo(rotation_of(matrix[:, :3], f"{path}: transform"), matrix[:, 3], record.scale)


def _read(path: Path, kind: type[T]) -> T:
    try:
        return read_typed(resolved(path), kind)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None


def _side(path: Path, value: float) -> int:
    if value != int(value) or not 1 <= value <= MAX_SIDE:
        raise InputError(f"{path}: render_width and render_height must be whole numbers up to {MAX_SIDE}, got {value}")
    return int(value)
