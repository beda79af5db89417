"""Photographs: finding, reading and resizing, and their lenses by EXIF.

Every image becomes uint8 RGB. EXIF orientation is ignored, as in COLMAP, because cameras refer to
the stored pixels.
"""

import logging
import os
import sys
from collections import Counter
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, UnidentifiedImageError

from gsbench.errors import InputError
from gsbench.files import GIT_LFS, LFS_REMEDY, MAX_NAME_BYTES, require_regular
from gsbench.scene.names import FILES, IMAGE_SUFFIXES
from gsbench.scene.options import Backdrop
from gsbench.scene.types import ByteArray
from gsbench.words import counted, is_one_line, some_of

log = logging.getLogger(__name__)

# photographs and videos that are not read, and how they are called
NOT_READ = {suffix: kind for kind, own in FILES["not_read"].items() for suffix in own}
# The formats of files with these suffixes. Without this list, Pillow would try some forty formats
# on every file.
FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP")  # JPEG includes MPO, which holds several JPEGs
EXIF_ORIENTATION = 0x0112
SIXTEEN_BIT_MODES = ("I;16", "I;16L", "I;16B", "I;16N")
_WIDE_MODES = ("I", "F")  # 32-bit integers and floats, which have no agreed value for white


def _unreadable(error: OSError) -> None:
    if not isinstance(error, PermissionError):  # a folder that may not be read counts as empty
        raise error


def list_images(folder: Path) -> list[str]:
    """The sorted image files below a folder, relative, with "/" as separator, without hidden files.

    Links to folders are followed, but not to those above, and no folder is read twice. Raises
    InputError for a name that is not UTF-8 or has line breaks, since no file of results could have
    it.
    """
    names: list[str] = []
    unread: Counter[str] = Counter()
    # A stranger's capture with a link to / would be a search of the whole disk for photographs.
    seen = {_identity(parent) for parent in folder.resolve().parents}
    places = [folder]
    for place in places:
        for parent, folders, files in os.walk(place, onerror=_unreadable):
            if (identity := _identity(Path(parent))) in seen:  # also ends circles of links
                folders.clear()
                continue
            seen.add(identity)
            folders[:] = sorted(name for name in folders if not name.startswith("."))
            # Links come last, so that images are listed under their real folder rather than under a
            # link to it.
            places += [path for name in folders if (path := Path(parent, name)).is_symlink()]
            for path in (Path(parent, name) for name in files if not name.startswith(".")):
                if path.suffix.lower() in IMAGE_SUFFIXES:
                    names.append(path.relative_to(folder).as_posix())
                elif kind := NOT_READ.get(path.suffix.lower()):
                    unread[kind] += 1
    if unread:
        kinds = " and ".join(counted(count, f"{kind} file") for kind, count in unread.items())
        is_one = unread.total() == 1
        log.warning(
            "%s: %s %s not read: save as PNG or JPEG", folder, kinds, "is" if is_one else "are"
        )
    if strange := sorted(name for name in names if not is_one_line(name)):
        advice = "rename them"
        if sys.getfilesystemencoding() != "utf-8":
            advice += f", or set PYTHONUTF8=1: Python reads names as {sys.getfilesystemencoding()}"
        raise InputError(
            f"{folder}: names that are not UTF-8, or have line breaks: {some_of(strange)}: {advice}"
        )
    return sorted(names)


def _identity(folder: Path) -> tuple[int, int]:
    status = folder.stat()
    return status.st_dev, status.st_ino


def check_picture_names(names: Iterable[str], folder: Path) -> None:
    """Raise `InputError` if the picture of a view has too long a name, or that of another view."""
    view_of: dict[str, str] = {}
    for name in names:
        picture = png_name(name)
        if len(picture.encode()) > MAX_NAME_BYTES:
            raise InputError(
                f"{folder / name}: a name of more than {MAX_NAME_BYTES} bytes, folders included: "
                "shorten it"
            )
        if picture in view_of:
            raise InputError(
                f"{folder}: the pictures of {view_of[picture]} and {name} would both be "
                f"{picture}: rename one"
            )
        view_of[picture] = name


def png_name(view_name: str) -> str:
    """The file name of a view's picture; sub-folders become part of the name."""
    return Path(view_name).with_suffix(".png").as_posix().replace("/", "__")


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) in px of the stored pixels, read from the header alone.

    Raises `InputError` if the file is missing or is not an image.
    """
    with open_image(path) as image:
        return image.size


def read_image(path: Path, backdrop: Backdrop = "black") -> ByteArray:
    """The image as [H, W, 3] uint8 RGB.

    Grey and palette images become RGB, 16-bit values keep their high byte, and transparent pixels
    are blended over ``backdrop`` (black is the default background of 3DGS). Raises `InputError` if
    the file is missing, truncated, not an image, or holds 32-bit or float pixels.
    """
    with open_image(path, decode=True) as image:
        if image.mode in _WIDE_MODES:
            raise InputError(
                f"{path}: pixels of type {image.mode!r} have no defined white: convert it to "
                "8-bit RGB"
            )
        if image.mode in SIXTEEN_BIT_MODES:
            grey = (np.asarray(image).astype(np.uint16) >> 8).astype(np.uint8)  # [H, W]
            return np.repeat(grey[..., None], 3, axis=2)
        if image.has_transparency_data:
            rgba = image.convert("RGBA")
            image = Image.alpha_composite(Image.new("RGBA", rgba.size, backdrop), rgba)
        return np.array(image.convert("RGB"), dtype=np.uint8)


def resize_image(image: ByteArray, width: int, height: int) -> ByteArray:
    """The image [H, W, 3] at another size, by a windowed sinc with three lobes.

    Pillow widens it by the scale against aliasing.
    """
    if image.shape[:2] == (height, width):
        return image
    return np.array(Image.fromarray(image).resize((width, height), Image.Resampling.LANCZOS))


def check_size(path: Path, size: tuple[int, int], camera_size: tuple[int, int]) -> None:
    """Raise `InputError` if aspect ratios of image and camera differ by more than rounding."""
    (width, height), (camera_width, camera_height) = size, camera_size
    if same_up_to_rounding(size, camera_size):
        return
    message = (
        f"{path}: the image is {width}x{height} px but its camera in the COLMAP model "
        f"{camera_width}x{camera_height}"
    )
    if same_up_to_rounding((height, width), camera_size):
        raise InputError(
            f"{message}: it is stored on its side, and COLMAP ignores EXIF orientations; use the "
            "files that the model was made from"
        )
    raise InputError(
        f"{message}: use the files that the model was made from, or an evenly scaled copy"
    )


def same_up_to_rounding(size: tuple[int, int], reference: tuple[int, int]) -> bool:
    """Return whether one scale maps ``reference`` to ``size`` up to one pixel on each side."""
    (width, height), (reference_width, reference_height) = size, reference
    lowest = max((width - 1) / reference_width, (height - 1) / reference_height)
    highest = min((width + 1) / reference_width, (height + 1) / reference_height)
    return lowest <= highest


def open_image(path: Path, decode: bool = False) -> Image.Image:
    """Open an image; raises `InputError` if it is missing or no image.

    With ``decode``, all pixels are read, and the error is raised for a damaged one, too.
    """
    require_regular(path)
    try:
        image = Image.open(path, formats=FORMATS)
        if decode:
            image.load()
        return image
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such image") from error
    except Exception as error:  # Pillow's readers may raise any exception on a damaged file
        is_none = isinstance(error, UnidentifiedImageError)
        reason = "not a readable image" if is_none else f"the image is damaged ({error})"
        with suppress(OSError), path.open("rb") as stream:
            if stream.read(len(GIT_LFS)) == GIT_LFS:
                reason += f", but {LFS_REMEDY}"
        raise InputError(f"{path}: {reason}: replace or remove it") from error


def write_png(image: ByteArray, path: Path, exif: bytes = b"") -> None:
    """Write an image [H, W, 3] or [H, W] as PNG."""
    # At zlib level 1, writing is about five times as fast as at the default level.
    Image.fromarray(image).save(path, format="PNG", compress_level=1, exif=exif)


MAKE, MODEL, EXIF_IFD = 0x010F, 0x0110, 0x8769
FOCAL_LENGTH, FOCAL_LENGTH_35MM, DIGITAL_ZOOM, LENS = 0x920A, 0xA405, 0xA404, 0xA434
MAX_TEXT = 80  # characters
UNKNOWN_CAMERA = "unknown camera"


def lens_of(path: Path) -> str:
    """Camera, lens and focal lengths of a photograph, as far as its EXIF data say them.

    Photographs with equal ones can share their intrinsics. A digital zoom changes the focal length
    on 35 mm film, too.
    """
    with open_image(path) as image:
        try:
            exif = image.getexif()
            own = exif.get_ifd(EXIF_IFD)
        except Exception:  # noqa: BLE001 - as in `open_image`; the pixels may still be intact
            return UNKNOWN_CAMERA
    make, model = _text(exif.get(MAKE)), _text(exif.get(MODEL))
    camera = model if model.startswith(make) else f"{make} {model}".strip()
    focal, on_film, zoom = map(
        _number, map(own.get, (FOCAL_LENGTH, FOCAL_LENGTH_35MM, DIGITAL_ZOOM))
    )
    parts = [
        camera or UNKNOWN_CAMERA,
        _text(own.get(LENS)),
        f"{focal:g} mm" if focal else "",
        f"({on_film:g} mm on 35 mm film)" if on_film else "",
        f"digital zoom {zoom:g}" if zoom and zoom != 1 else "",
    ]
    return " ".join(filter(None, parts))


def _text(value: Any) -> str:
    if not isinstance(value, str):
        return ""
    return "".join(filter(str.isprintable, value)).strip()[:MAX_TEXT]


def _number(value: Any) -> float | None:
    """A positive number to three digits, which is finer than lenses report; None if there is none.

    EXIF writes 0 for unknown.
    """
    try:
        number = float(f"{float(value):.3g}")
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if 0 < number < float("inf") else None
