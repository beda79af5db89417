"""Videos: cameras along a path that is made from a trial's cameras, and their pictures as a file.

The MP4 holds VP9, which browsers and players know, since the encoder of H.264 that wheels bring (x264, in those of
PyAV and imageio-ffmpeg) is under the GPL; the FFmpeg in OpenCV's wheels is under the LGPL, without it.
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.interpolate import CubicSpline

from gsbench.errors import InputError
from gsbench.files import atomic, place_of
from gsbench.scene.camera import Camera
from gsbench.scene.hold_out import arrange, looked_at, scene_up
from gsbench.system.install import install_command

Picture = NDArray[np.uint8]
Array = NDArray[np.float64]

SUFFIXES = (".mp4", ".webp")
PACKAGE, EXTRA = "cv2", "video"
CODEC = "vp09"
WEBP_QUALITY = 80  # Pillow's default
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
        raise InputError(f"--out {file}: MP4 needs OpenCV: {install_command(EXTRA)}; or name a file .webp")
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
            _write_webp(temporary, pictures, fps)


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


def _write_webp(file: Path, pictures: Iterable[Picture], fps: float) -> None:
    frames: Iterator[Image.Image] = (Image.fromarray(picture) for picture in pictures)
    duration = round(1000 / fps)  # ms
    next(frames).save(
        file, format="WEBP", save_all=True, append_images=frames, loop=0, duration=duration, quality=WEBP_QUALITY
    )


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
        raise InputError("this way through the cameras looks straight up or down: give the other --along")
    forward, right = ahead / np.linalg.norm(ahead), right / length
    rotation = np.stack([right, np.cross(forward, right), forward])  # x right, y down, z ahead
    size = (like.width, like.height)
    return Camera(*size, like.fx, like.fy, like.width / 2, like.height / 2, rotation, -rotation @ center)
