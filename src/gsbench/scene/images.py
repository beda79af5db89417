"""Reading photographs and making them smaller.

Every image becomes uint8 RGB. EXIF orientation is ignored, as COLMAP ignores it: a camera belongs to stored pixels.
"""

from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from gsbench.errors import InputError
from gsbench.files import require_regular
from gsbench.scene.options import Behind

Resample = Literal["lanczos", "area", "bicubic"]

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp"})
# Formats of files with these names. Pillow would read some forty formats, whatever the name.
FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP")  # MPO, of several JPEGs, is one of JPEG's
EXIF_ORIENTATION = 0x0112
_FILTERS = {"lanczos": Image.Resampling.LANCZOS, "area": Image.Resampling.BOX, "bicubic": Image.Resampling.BICUBIC}
_SIXTEEN_BIT_MODES = ("I;16", "I;16L", "I;16B", "I;16N")
_WIDE_MODES = ("I", "F")  # 32-bit integer and float: no agreed white point


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) in px of the stored pixels, from the header alone.

    Raises `InputError` if the file is missing or no image.
    """
    with open_image(path) as image:
        return image.size


def exif_orientation(path: Path) -> int:
    """The EXIF orientation tag, 1 (upright) where there is none that can be read."""
    with open_image(path) as image:
        try:
            return int(image.getexif().get(EXIF_ORIENTATION, 1))
        except Exception:  # noqa: BLE001 - as in `open_image`; the pixels may be sound
            return 1


def read_image(path: Path, behind: Behind = "black") -> NDArray[np.uint8]:
    """The image as [H, W, 3] uint8 RGB.

    Grey and palette images become RGB, 16-bit values keep their high byte, and transparent pixels are laid over what
    is ``behind`` (black is the default background of 3DGS). Raises `InputError` if the file is missing, truncated, no
    image, or holds 32-bit or float pixels.
    """
    with open_image(path) as image:
        if image.mode in _WIDE_MODES:
            raise InputError(f"{path}: pixels of type {image.mode!r} have no defined white: convert it to 8-bit RGB")
        try:
            image.load()
        except Exception as error:  # as above
            raise InputError(f"{path}: the image is damaged ({error}): replace or remove it") from error
        if image.mode in _SIXTEEN_BIT_MODES:
            grey = (np.asarray(image).astype(np.uint16) >> 8).astype(np.uint8)  # [H, W]
            return np.repeat(grey[..., None], 3, axis=2)
        if image.has_transparency_data:
            rgba = image.convert("RGBA")
            image = Image.alpha_composite(Image.new("RGBA", rgba.size, behind), rgba)
        return np.array(image.convert("RGB"), dtype=np.uint8)


def resize_image(
    image: NDArray[np.uint8], width: int, height: int, resample: Resample = "lanczos"
) -> NDArray[np.uint8]:
    """The image [H, W, 3] at another size.

    ``lanczos`` is Pillow's windowed sinc with three lobes, widened to the scale (so it does not alias); ``area`` is the
    mean over each pixel's footprint; ``bicubic`` Pillow's, with a = -0.5 and widened as well.
    """
    if resample not in _FILTERS:
        raise InputError(f"scene.resample must be one of {', '.join(_FILTERS)}, got {resample!r}")
    if image.shape[:2] == (height, width):
        return image
    return np.array(Image.fromarray(image).resize((width, height), _FILTERS[resample]))


def check_size(path: Path, size: tuple[int, int], camera_size: tuple[int, int]) -> None:
    """Raise `InputError` unless the image has its camera's aspect up to the rounding of its sides to whole pixels."""
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
    """Return whether one common scale takes ``reference`` to ``size`` with every side off by at most one pixel."""
    (width, height), (reference_width, reference_height) = size, reference
    lowest = max((width - 1) / reference_width, (height - 1) / reference_height)
    highest = min((width + 1) / reference_width, (height + 1) / reference_height)
    return lowest <= highest


def open_image(path: Path) -> Image.Image:
    """The image as Pillow opens it, pixels not read yet; raises `InputError` if the file is missing or no image."""
    require_regular(path)
    try:
        return Image.open(path, formats=FORMATS)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such image") from error
    except Exception as error:  # a reader of Pillow's may raise anything where a file is damaged
        reason = "not a readable image" if isinstance(error, UnidentifiedImageError) else str(error)
        raise InputError(f"{path}: {reason}: replace or remove it") from error
