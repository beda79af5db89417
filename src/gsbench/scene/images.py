"""Reading and resizing photographs.

Every image becomes uint8 RGB. EXIF orientation is ignored, as in COLMAP, because cameras refer to the stored pixels.
"""

from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from gsbench.errors import InputError
from gsbench.files import require_regular
from gsbench.scene.options import Backdrop

Resample = Literal["lanczos", "area", "bicubic"]

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp"})
# The formats of files with these suffixes. Without this list, Pillow would try some forty formats on every file.
FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP")  # JPEG includes MPO, which holds several JPEGs
EXIF_ORIENTATION = 0x0112
_FILTERS = {"lanczos": Image.Resampling.LANCZOS, "area": Image.Resampling.BOX, "bicubic": Image.Resampling.BICUBIC}
_SIXTEEN_BIT_MODES = ("I;16", "I;16L", "I;16B", "I;16N")
_WIDE_MODES = ("I", "F")  # 32-bit integer and float, which have no agreed value for white


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) in px of the stored pixels, read from the header alone.

    Raises `InputError` if the file is missing or is not an image.
    """
    with open_image(path) as image:
        return image.size


def exif_orientation(path: Path) -> int:
    """The EXIF orientation tag, or 1 (upright) if there is none or it cannot be read."""
    with open_image(path) as image:
        try:
            return int(image.getexif().get(EXIF_ORIENTATION, 1))
        except Exception:  # noqa: BLE001 - as in `open_image`; the pixels may still be intact
            return 1


def read_image(path: Path, backdrop: Backdrop = "black") -> NDArray[np.uint8]:
    """The image as [H, W, 3] uint8 RGB.

    Grey and palette images become RGB, 16-bit values keep their high byte, and transparent pixels are blended over
    ``backdrop`` (black is the default background of 3DGS). Raises `InputError` if the file is missing, truncated, not
    an image, or holds 32-bit or float pixels.
    """
    with open_image(path) as image:
        if image.mode in _WIDE_MODES:
            raise InputError(f"{path}: pixels of type {image.mode!r} have no defined white: convert it to 8-bit RGB")
        try:
            image.load()
        except Exception as error:  # as in `open_image`
            raise InputError(f"{path}: the image is damaged ({error}): replace or remove it") from error
        if image.mode in _SIXTEEN_BIT_MODES:
            grey = (np.asarray(image).astype(np.uint16) >> 8).astype(np.uint8)  # [H, W]
            return np.repeat(grey[..., None], 3, axis=2)
        if image.has_transparency_data:
            rgba = image.convert("RGBA")
            image = Image.alpha_composite(Image.new("RGBA", rgba.size, backdrop), rgba)
        return np.array(image.convert("RGB"), dtype=np.uint8)


def resize_image(
    image: NDArray[np.uint8], width: int, height: int, resample: Resample = "lanczos"
) -> NDArray[np.uint8]:
    """The image [H, W, 3] at another size.

    ``lanczos`` is Pillow's windowed sinc with three lobes, widened by the scale against aliasing. ``bicubic`` is
    Pillow's with a = -0.5, widened too. ``area`` is the mean over each new pixel's area.
    """
    if resample not in _FILTERS:
        raise InputError(f"scene.resample must be one of {', '.join(_FILTERS)}, got {resample!r}")
    if image.shape[:2] == (height, width):
        return image
    return np.array(Image.fromarray(image).resize((width, height), _FILTERS[resample]))


def check_size(path: Path, size: tuple[int, int], camera_size: tuple[int, int]) -> None:
    """Raise `InputError` if the aspect ratios of image and camera differ by more than rounding to whole pixels."""
    (width, height), (camera_width, camera_height) = size, camera_size
    if same_up_to_rounding(size, camera_size):
        return
    message = (
        f"{path}: the image is {width}x{height} px but its camera in the COLMAP model {camera_width}x{camera_height}"
    )
    if same_up_to_rounding((height, width), camera_size):
        raise InputError(
            f"{message}: it is stored on its side (EXIF orientation {exif_orientation(path)}, which COLMAP ignores); "
            "use the files that the model was made from"
        )
    raise InputError(f"{message}: use the files that the model was made from, or an evenly scaled copy")


def same_up_to_rounding(size: tuple[int, int], reference: tuple[int, int]) -> bool:
    """Return whether one scale maps ``reference`` to ``size`` with an error of at most one pixel on each side."""
    (width, height), (reference_width, reference_height) = size, reference
    lowest = max((width - 1) / reference_width, (height - 1) / reference_height)
    highest = min((width + 1) / reference_width, (height + 1) / reference_height)
    return lowest <= highest


def open_image(path: Path) -> Image.Image:
    """Open an image with Pillow, without reading pixels; raises `InputError` if it is missing or is not an image."""
    require_regular(path)
    try:
        return Image.open(path, formats=FORMATS)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such image") from error
    except Exception as error:  # Pillow's readers may raise any exception on a damaged file
        reason = "not a readable image" if isinstance(error, UnidentifiedImageError) else str(error)
        raise InputError(f"{path}: {reason}: replace or remove it") from error
