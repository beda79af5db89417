"""Photographs and masks: finding, reading, resizing, and filling in what a mask ignores.

Every image becomes uint8 RGB. EXIF orientation is ignored, as in COLMAP, because cameras refer to
the stored pixels.

A mask says which pixels of a photograph count: black pixels are ignored, all others count. COLMAP
extracts no features where a mask "is black (pixel intensity value 0 in grayscale)" (its FAQ, "Mask
image regions"), and nerfstudio trains only where a mask is not 0 (its page "Data conventions").
Ignored pixels are replaced before any other step reads a photograph, so that they cannot influence
a result.
"""

import logging
import os
import shutil
import sys
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from gsbench.errors import InputError
from gsbench.files import MAX_NAME_BYTES, require_regular
from gsbench.scene.options import Backdrop
from gsbench.words import counted, is_one_line, some_of

log = logging.getLogger(__name__)

Resample = Literal["lanczos", "area", "bicubic"]

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp"})
# photographs and videos that are not read, and how they are called
NOT_READ = dict.fromkeys((".heic", ".heif"), "HEIC") | {".avif": "AVIF", ".jxl": "JPEG XL"}
NOT_READ |= dict.fromkeys((".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2"), "raw")
NOT_READ |= {".exr": "EXR", ".gif": "GIF"} | dict.fromkeys((".mp4", ".mov", ".insv"), "video")
# The formats of files with these suffixes. Without this list, Pillow would try some forty formats
# on every file.
FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP")  # JPEG includes MPO, which holds several JPEGs
EXIF_ORIENTATION = 0x0112
GIT_LFS = b"version https://git-lfs"
_FILTERS = {
    "lanczos": Image.Resampling.LANCZOS,
    "area": Image.Resampling.BOX,
    "bicubic": Image.Resampling.BICUBIC,
}
_SIXTEEN_BIT_MODES = ("I;16", "I;16L", "I;16B", "I;16N")
_WIDE_MODES = ("I", "F")  # 32-bit integers and floats, which have no agreed value for white

Mask = NDArray[np.bool_]  # [H, W], True where a pixel counts

SUFFIX = ".png"
WHITE = np.uint8(255)
IMAGES, MASKS = "images", "masks"  # in the folder of `prepare_photograph`
# largest share of pixels between black and the brightest value; a photograph has far more
MAX_GREY_SHARE = 0.05
NEARLY_ONE = 1 - 1e-6  # a mean of ones in float32 may round to less than 1
WHOLE = 0  # all parts of a path


def list_images(folder: Path) -> list[str]:
    """The sorted image files below a folder, relative, with "/" as separator, without hidden files.

    Links to folders are followed, and no folder is read twice. Raises InputError for a name that is
    not UTF-8 or has line breaks, since no file of results could have it.
    """
    names: list[str] = []
    unread: Counter[str] = Counter()
    folders, links, seen = [folder], list[Path](), set[tuple[int, int]]()
    while folders or links:
        # Links come last, so that images are listed under their real folder rather than under a
        # link to it.
        parent = folders.pop() if folders else links.pop(0)
        status = parent.stat()
        if (status.st_dev, status.st_ino) in seen:  # also ends circles of links
            continue
        seen.add((status.st_dev, status.st_ino))
        for entry in sorted(_entries(parent), key=lambda entry: entry.name):
            if entry.name.startswith("."):
                continue
            if entry.is_dir():
                (links if entry.is_symlink() else folders).append(Path(entry.path))
            elif Path(entry.name).suffix.lower() in IMAGE_SUFFIXES:
                names.append(Path(entry.path).relative_to(folder).as_posix())
            elif kind := NOT_READ.get(Path(entry.name).suffix.lower()):
                unread[kind] += 1
    if unread:
        files = " and ".join(counted(count, f"{kind} file") for kind, count in unread.items())
        is_one = unread.total() == 1
        log.warning("%s: %s %s not read: save as JPEG", folder, files, "is" if is_one else "are")
    if strange := sorted(name for name in names if not is_one_line(name)):
        advice = "rename them"
        if sys.getfilesystemencoding() != "utf-8":
            advice += f", or set PYTHONUTF8=1: Python reads names as {sys.getfilesystemencoding()}"
        raise InputError(
            f"{folder}: names that are not UTF-8, or have line breaks: {some_of(strange)}: {advice}"
        )
    return sorted(names)


def _entries(folder: Path) -> list[os.DirEntry[str]]:
    try:
        with os.scandir(folder) as entries:
            return list(entries)
    except PermissionError:  # treated as an empty folder
        return []


def match_names(
    wanted: Iterable[str], files: Iterable[str], other_folders: bool = False
) -> dict[str, str]:
    """Map each wanted image name to its file; names without a file are left out.

    A file of the same name comes first, then the only file whose path differs in the extension
    alone (``a.png`` for ``a.JPG``), then the only one that differs in capitals too (``IMG_1.JPG``
    for ``img_1.jpg``). Names that Unicode counts as equal are equal. With ``other_folders``, if no
    file fits any name, names and files are compared by the last parts of their paths, as many as
    give a match (``b/a.jpg`` for ``C:\\data\\b\\a.jpg``). Raises `InputError` if several such files
    fit a name, or if several names fit such a file.
    """
    names, found = list(dict.fromkeys(wanted)), set(files)
    matches = _matched(names, found, WHOLE)
    longest = max((len(_parts(name)) for name in names), default=0)
    for count in range(longest if other_folders else 0, 0, -1):
        if not matches:
            matches = _matched(names, found, count)
    return matches


def _parts(path: str) -> list[str]:
    return path.replace("\\", "/").split("/")


def _matched(wanted: Iterable[str], files: Iterable[str], count: int) -> dict[str, str]:
    """`match_names` by the last ``count`` parts of each path."""

    def tail(path: str) -> str:
        # macOS writes é as two characters (NFD) where most programs write one (NFC)
        path = unicodedata.normalize("NFC", path)
        return path if count == WHOLE else "/".join(_parts(path)[-count:])

    unmatched, free = dict.fromkeys(wanted), set(files)
    matches = {name: name for name in unmatched if name in free}
    for key_of in (
        tail,
        lambda path: stem_of(tail(path)),
        lambda path: tail(path).casefold(),
        lambda path: stem_of(tail(path)).casefold(),
    ):
        # Better matches come first and take their files, so that no name is matched to the file of
        # another name.
        free -= set(matches.values())
        by_key: dict[str, list[str]] = defaultdict(list)
        for file in free:
            by_key[key_of(file)].append(file)
        names_by_key: dict[str, list[str]] = defaultdict(list)
        for name in unmatched:
            if name not in matches and key_of(name) in by_key:
                names_by_key[key_of(name)].append(name)
        for key, names in names_by_key.items():
            found = sorted(by_key[key])
            if len(found) > 1:
                raise InputError(
                    f"{names[0]} may be {' or '.join(found)}: keep one of these files, or name "
                    "one exactly"
                )
            if len(names) > 1:
                raise InputError(
                    f"{found[0]} may be {' or '.join(sorted(names))}: give each image a file of "
                    "its own"
                )
            matches[names[0]] = found[0]
    return matches


def same_folder(one: str, other: str) -> bool:
    """Return whether two names have the same folder, up to capitals."""
    one, other = (unicodedata.normalize("NFC", name) for name in (one, other))
    return _parts(one)[:-1] == _parts(other)[:-1] or one.casefold() == other.casefold()


def stem_of(name: str) -> str:
    """The path of an image without its extension."""
    path = PurePosixPath(name)
    return (path.with_suffix("") if path.suffix.lower() in IMAGE_SUFFIXES else path).as_posix()


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


def exif_orientation(path: Path) -> int:
    """The EXIF orientation tag, or 1 (upright) if there is none or it cannot be read."""
    with open_image(path) as image:
        try:
            return int(image.getexif().get(EXIF_ORIENTATION, 1))
        except Exception:  # noqa: BLE001 - as in `open_image`; the pixels may still be intact
            return 1


def read_image(path: Path, backdrop: Backdrop = "black") -> NDArray[np.uint8]:
    """The image as [H, W, 3] uint8 RGB.

    Grey and palette images become RGB, 16-bit values keep their high byte, and transparent pixels
    are blended over ``backdrop`` (black is the default background of 3DGS). Raises `InputError` if
    the file is missing, truncated, not an image, or holds 32-bit or float pixels.
    """
    with open_image(path) as image:
        if image.mode in _WIDE_MODES:
            raise InputError(
                f"{path}: pixels of type {image.mode!r} have no defined white: convert it to "
                "8-bit RGB"
            )
        try:
            image.load()
        except Exception as error:  # as in `open_image`
            raise InputError(
                f"{path}: the image is damaged ({error}): replace or remove it"
            ) from error
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

    ``lanczos`` is Pillow's windowed sinc with three lobes, widened by the scale against aliasing.
    ``bicubic`` is Pillow's with a = -0.5, widened too. ``area`` is the mean over each new pixel's
    area.
    """
    if resample not in _FILTERS:
        raise InputError(f"scene.resample must be one of {', '.join(_FILTERS)}, got {resample!r}")
    if image.shape[:2] == (height, width):
        return image
    return np.array(Image.fromarray(image).resize((width, height), _FILTERS[resample]))


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
            f"{message}: it is stored on its side (EXIF orientation {exif_orientation(path)}, "
            "which COLMAP ignores); use the files that the model was made from"
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


def open_image(path: Path) -> Image.Image:
    """Open an image without reading pixels; raises `InputError` if it is missing or no image."""
    require_regular(path)
    try:
        return Image.open(path, formats=FORMATS)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such image") from error
    except Exception as error:  # Pillow's readers may raise any exception on a damaged file
        reason = "not a readable image" if isinstance(error, UnidentifiedImageError) else str(error)
        with path.open("rb") as stream:
            if stream.read(len(GIT_LFS)) == GIT_LFS:
                reason += ", but a pointer of Git LFS (git lfs pull)"
        raise InputError(f"{path}: {reason}: replace or remove it") from error


def find_masks(folder: Path, images: Path, names: Sequence[str]) -> dict[str, Path]:
    """The mask file in ``folder`` of each image, as COLMAP names it: ``b.jpg.png`` for ``b.jpg``.

    ``names`` are paths below ``images``, the folder of the images. Raises InputError naming the
    images without a mask, or for a mask that is not an image or differs in size from its
    photograph.
    """
    masks = {name: folder / f"{name}{SUFFIX}" for name in names}
    if missing := [name for name, mask in masks.items() if not mask.is_file()]:
        raise InputError(
            f"scene.masks: no mask of {some_of(missing)} in {folder}: add {missing[0]}{SUFFIX} "
            "(all white where every pixel counts)"
        )
    for name, mask in masks.items():
        size, wanted = image_size(mask), image_size(images / name)
        if size != wanted:
            raise InputError(
                f"{mask}: the mask is {size[0]}x{size[1]} px and its image {name} "
                f"{wanted[0]}x{wanted[1]}: give masks of the images' size"
            )
    return masks


def read_mask(path: Path) -> Mask:
    """Read a mask [H, W]: False where the file is black.

    Raises InputError for a file that is no mask: with colours, with many greys, or black
    everywhere.
    """
    with open_image(path) as image:
        try:
            image.load()
            transparent = image.has_transparency_data
            if transparent and np.asarray(image.convert("RGBA"))[..., 3].min() < 255:
                raise InputError(
                    f"{path}: a mask says by black what is ignored, not by transparency: save it "
                    "as grey"
                )
            in_colors = image.mode in ("P", "CMYK", "YCbCr", "RGBA", "LA")
            pixels = np.asarray(image.convert("RGB") if in_colors else image)
        except InputError:
            raise
        except Exception as error:  # Pillow's readers may raise any exception on a damaged file
            raise InputError(f"{path}: the mask is damaged ({error}): replace it") from error
    if pixels.ndim == 3:
        if (pixels != pixels[..., :1]).any():
            raise InputError(
                f"{path}: is in colours, and no mask: make it black where pixels are ignored, "
                "else white"
            )
        pixels = pixels.max(axis=2)
    mask: Mask = pixels != 0
    if not mask.any():
        raise InputError(
            f"{path}: the mask is black all over, so no pixel counts: correct it, or leave the "
            "image out"
        )
    grey_share = float((mask & (pixels != pixels.max())).mean())
    if grey_share > MAX_GREY_SHARE:
        raise InputError(
            f"{path}: {grey_share:.0%} of its pixels are grey, so it is not a mask: make it black "
            "where pixels are ignored, else white"
        )
    return mask


def write_mask(mask: Mask, path: Path) -> None:
    """Write the mask as a PNG in black and white."""
    write_png(mask.astype(np.uint8) * WHITE, path)


def write_png(image: NDArray[np.uint8], path: Path, exif: bytes = b"") -> None:
    """Write an image [H, W, 3] or [H, W] as PNG."""
    # At zlib level 1, writing is about five times as fast as at the default level.
    Image.fromarray(image).save(path, format="PNG", compress_level=1, exif=exif)


def prepare_photograph(
    folder: Path, images: Path, masks: Mapping[str, Path], name: str, backdrop: Backdrop = "black"
) -> None:
    """Write the photograph ``name`` without its ignored and transparent pixels.

    The photograph goes to ``images/<name>`` below ``folder``: a copy if nothing changes, else a PNG
    with the original EXIF data. Its mask, if any, goes to ``masks/<name>.png`` in black and white.
    """
    target, mask_target = folder / IMAGES / name, prepared_mask(folder, name)
    for path in (target, mask_target):
        path.parent.mkdir(parents=True, exist_ok=True)
    mask = None
    if name in masks:
        mask = read_mask(masks[name])
        write_mask(mask, mask_target)
    with open_image(images / name) as original:
        exif, transparent = original.info.get("exif", b""), original.has_transparency_data
    if (mask is None or mask.all()) and (backdrop == "black" or not transparent):
        shutil.copyfile(images / name, target)
        return
    pixels = read_image(images / name, backdrop)
    if mask is not None:
        if pixels.shape[:2] != mask.shape:
            raise InputError(f"{masks[name]}: the mask changed while it was read: run again")
        pixels = fill_ignored(pixels, mask)
    write_png(pixels, target, exif)


def prepared_mask(folder: Path, name: str) -> Path:
    """The file of the mask that `prepare_photograph` writes, as COLMAP names it."""
    return folder / MASKS / f"{name}{SUFFIX}"


def fill_ignored(image: NDArray[np.uint8], mask: Mask) -> NDArray[np.uint8]:
    """``image`` [H, W, 3] with its ignored pixels interpolated from counted pixels nearby.

    Uses the pull and push of Gortler et al. 1996, "The Lumigraph", section 3.4.1: the counted
    pixels are averaged over blocks of 2, 4, 8, … pixels; then coarser levels are interpolated
    bilinearly into finer pixels without a value. The filling leaves no edge at the border of the
    mask where features would be detected.
    """
    filled = _pull_push(image.astype(np.float32), mask)
    return np.where(mask[..., None], image, np.rint(filled).astype(np.uint8))


def _pull_push(image: NDArray[np.float32], mask: Mask) -> NDArray[np.float32]:
    if mask.all():
        return image
    height, width = mask.shape
    to_even = ((0, height % 2), (0, width % 2))
    weights = np.pad(mask, to_even).astype(np.float32)
    rows, columns = weights.shape[0] // 2, weights.shape[1] // 2
    blocks = (rows, 2, columns, 2)
    padded = np.pad(image * mask[..., None], (*to_even, (0, 0)))
    sums = padded.reshape(*blocks, 3).sum((1, 3))  # [H/2, W/2, 3]
    counted = weights.reshape(blocks).sum((1, 3))  # [H/2, W/2]
    coarse = _pull_push(sums / np.maximum(counted, 1)[..., None], counted > 0)
    pushed = _double(_double(coarse, 0), 1)[:height, :width]
    return np.where(mask[..., None], image, pushed)


def _double(image: NDArray[np.float32], axis: int) -> NDArray[np.float32]:
    """``image`` [H, W, 3] with twice as many pixels along ``axis``, interpolated linearly."""
    ends = [(0, 0)] * image.ndim
    ends[axis] = (1, 1)
    padded = np.pad(image, ends, mode="edge")
    length = image.shape[axis]
    before, after = (np.take(padded, range(start, start + length), axis) for start in (0, 2))
    pair = np.stack([0.75 * image + 0.25 * before, 0.75 * image + 0.25 * after], axis=axis + 1)
    shape = list(image.shape)
    shape[axis] = 2 * length
    return pair.reshape(shape)


def resize_mask(mask: Mask, width: int, height: int) -> Mask:
    """The mask at another size: a pixel counts if all original ones centred in its area count.

    The filters that resize photographs reach further than that. Beyond the mask's border they use
    the pixels that `fill_ignored` made.
    """
    if mask.shape == (height, width):
        return mask
    shares = Image.fromarray(mask.astype(np.float32)).resize((width, height), Image.Resampling.BOX)
    return np.asarray(shares) >= NEARLY_ONE
