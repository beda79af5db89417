"""Masks: which pixels of a photograph count. Black is ignored, everything else counts.

COLMAP extracts no features where a mask "is black (pixel intensity value 0 in grayscale)" (its FAQ, "Mask image
regions"), and nerfstudio trains only where a mask is not 0 (its page "Data conventions"). What lies under a mask
is replaced before anything looks at a photograph, so that not one bit of it can have a part in a result.
"""

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gsbench.errors import InputError
from gsbench.scene.images import image_size, open_image, read_image
from gsbench.scene.options import Behind
from gsbench.words import some_of

Mask = NDArray[np.bool_]  # [H, W], True where a pixel counts

SUFFIX = ".png"
WHITE = np.uint8(255)
IMAGES, MASKS = "images", "masks"  # in the folder of `prepare`
MOST_GREY = 0.05  # of a mask's pixels may be neither its darkest nor its brightest; a photograph has far more
NEARLY_ONE = 1 - 1e-6  # a mean of ones in float32
_FAST_PNG = 1  # zlib's level


def find_masks(folder: Path, names: Sequence[str]) -> dict[str, Path]:
    """The mask in ``folder`` of each image in ``names``, paths below the images' folder: for ``a/b.jpg`` the file
    ``a/b.jpg.png``, as COLMAP names it. Raises InputError naming the images that have none.
    """
    found = {name: folder / f"{name}{SUFFIX}" for name in names}
    if missing := [name for name, mask in found.items() if not mask.is_file()]:
        raise InputError(
            f"scene.masks: no mask of {some_of(missing)} in {folder}: add {missing[0]}{SUFFIX} (all white where every "
            "pixel counts)"
        )
    return found


def check_sizes(images: Path, masks: Mapping[str, Path]) -> None:
    """Raise `InputError` naming a mask that is not an image, or not of the size of its photograph below ``images``."""
    for name, mask in masks.items():
        size, wanted = image_size(mask), image_size(images / name)
        if size != wanted:
            raise InputError(
                f"{mask}: the mask is {size[0]}x{size[1]} px and its image {name} {wanted[0]}x{wanted[1]}: give masks "
                "of the images' size"
            )


def read_mask(path: Path) -> Mask:
    """The mask [H, W] of a file: False where it is black.

    Raises InputError for what is not a mask: a picture in colours or of many greys, or one that is black all over.
    """
    with open_image(path) as image:
        try:
            image.load()
            if image.has_transparency_data and np.asarray(image.convert("RGBA"))[..., 3].min() < 255:
                raise InputError(f"{path}: a mask says by black what is ignored, not by transparency: save it as grey")
            pixels = np.asarray(image.convert("RGB") if image.mode in ("P", "CMYK", "YCbCr", "RGBA", "LA") else image)
        except InputError:
            raise
        except Exception as error:  # a reader of Pillow's may raise anything where a file is damaged
            raise InputError(f"{path}: the mask is damaged ({error}): replace it") from error
    if pixels.ndim == 3:
        if (pixels != pixels[..., :1]).any():
            raise InputError(f"{path}: is in colours, and no mask: make it black where pixels are ignored, else white")
        pixels = pixels[..., 0]
    counts = pixels != 0
    if not counts.any():
        raise InputError(f"{path}: the mask is black all over, so no pixel counts: correct it, or leave the image out")
    between = float((counts & (pixels != pixels.max())).mean())
    if between > MOST_GREY:
        raise InputError(
            f"{path}: {between:.0%} of its pixels are grey, so it is not a mask: make it black where pixels are "
            "ignored, else white"
        )
    return counts


def write_mask(counts: Mask, path: Path) -> None:
    """Write the mask as a PNG in black and white."""
    Image.fromarray(counts.astype(np.uint8) * WHITE).save(path, format="PNG", compress_level=_FAST_PNG)


def prepare(folder: Path, images: Path, masks: Mapping[str, Path], name: str, behind: Behind = "black") -> None:
    """Write the photograph ``name`` with its ignored pixels replaced, and its mask in black and white, if it has one.

    Transparent pixels are laid over ``behind``. They go to ``images/<name>``, a PNG with the EXIF data of the original
    unless nothing changes, and ``masks/<name>.png`` below ``folder``.
    """
    target, mask = folder / IMAGES / name, prepared_mask(folder, name)
    for path in (target, mask):
        path.parent.mkdir(parents=True, exist_ok=True)
    counts = None
    if name in masks:
        counts = read_mask(masks[name])
        write_mask(counts, mask)
    with open_image(images / name) as original:
        exif, transparent = original.info.get("exif", b""), original.has_transparency_data
    if (counts is None or counts.all()) and (behind == "black" or not transparent):
        shutil.copyfile(images / name, target)
        return
    pixels = read_image(images / name, behind)
    if counts is not None:
        if pixels.shape[:2] != counts.shape:
            raise InputError(f"{masks[name]}: the mask changed while it was read: run again")
        pixels = fill(pixels, counts)
    Image.fromarray(pixels).save(target, format="PNG", compress_level=_FAST_PNG, exif=exif)


def prepared_mask(folder: Path, name: str) -> Path:
    """The file into which `prepare` writes the mask of the image ``name``, as COLMAP names it."""
    return folder / MASKS / f"{name}{SUFFIX}"


def fill(image: NDArray[np.uint8], counts: Mask) -> NDArray[np.uint8]:
    """``image`` [H, W, 3] with its ignored pixels made from those that count nearby.

    By the pull and push of Gortler et al. 1996, "The Lumigraph", section 3.4.1: means over what counts in blocks of 2,
    4, 8, … pixels, and from the coarsest back, bilinearly, into what has no finer value. So no edge stands where a
    mask begins, and features find none.
    """
    filled = _fill(image.astype(np.float32), counts)
    return np.where(counts[..., None], image, np.rint(filled).astype(np.uint8))


def _fill(image: NDArray[np.float32], counts: Mask) -> NDArray[np.float32]:
    if counts.all():
        return image
    height, width = counts.shape
    even = ((0, height % 2), (0, width % 2))
    weights = np.pad(counts, even).astype(np.float32)
    rows, columns = weights.shape[0] // 2, weights.shape[1] // 2
    blocks = (rows, 2, columns, 2)
    sums = (np.pad(image * counts[..., None], (*even, (0, 0)))).reshape(*blocks, 3).sum((1, 3))  # [H/2, W/2, 3]
    known = weights.reshape(blocks).sum((1, 3))  # [H/2, W/2]
    coarse = _fill(sums / np.maximum(known, 1)[..., None], known > 0)
    pushed = _twice(_twice(coarse, 0), 1)[:height, :width]
    return np.where(counts[..., None], image, pushed)


def _twice(image: NDArray[np.float32], axis: int) -> NDArray[np.float32]:
    """``image`` [H, W, 3] with twice as many pixels along ``axis``, interpolated linearly."""
    ends = [(1, 1) if dimension == axis else (0, 0) for dimension in range(image.ndim)]
    padded = np.pad(image, ends, mode="edge")
    length = image.shape[axis]
    before, after = (np.take(padded, range(start, start + length), axis) for start in (0, 2))
    pair = np.stack([0.75 * image + 0.25 * before, 0.75 * image + 0.25 * after], axis=axis + 1)  # float32 stays
    shape = list(image.shape)
    shape[axis] = 2 * length
    return pair.reshape(shape)


def resize_mask(counts: Mask, width: int, height: int) -> Mask:
    """The mask at another size: a pixel counts where all do whose centres lie in its area.

    Filters of a photograph reach further, as they do at its border; there they find what `fill` has made.
    """
    if counts.shape == (height, width):
        return counts
    shares = Image.fromarray(counts.astype(np.float32)).resize((width, height), Image.Resampling.BOX)
    return np.asarray(shares) >= NEARLY_ONE
