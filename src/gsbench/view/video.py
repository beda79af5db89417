"""Writing of pictures as a video: MP4 by OpenCV's FFmpeg, else animated WebP or GIF by Pillow.

The MP4 holds VP9, which browsers and players know, since the encoder of H.264 that wheels bring (x264, in those of
PyAV and imageio-ffmpeg) is under the GPL; the FFmpeg in OpenCV's wheels is under the LGPL, without it.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gsbench.errors import InputError
from gsbench.files import atomic, place_of
from gsbench.system.install import install_command

Picture = NDArray[np.uint8]

SUFFIXES = (".mp4", ".webp", ".gif")
PACKAGE, EXTRA = "cv2", "video"
CODEC = "vp09"
WEBP_QUALITY = 80  # Pillow's default
GIF_STEP = 10  # ms: GIF counts in hundredths of a second


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
