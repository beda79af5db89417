"""Pictures beside photographs: masks, and others such as a sensor's depth.

A mask says which pixels of a photograph count: black pixels are ignored, all others count. COLMAP
extracts no features where a mask "is black (pixel intensity value 0 in grayscale)" (its FAQ, "Mask
image regions"), and nerfstudio trains only where a mask is not 0 (its page "Data conventions").
Ignored pixels are replaced before any other step reads a photograph, so that they cannot influence
a result.

``scene.beside`` names the others, which become pixels of the trained views. Losses, terms and
densifiers read them (docs/ideas.md).
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gsbench.errors import InputError
from gsbench.files import DAMAGE, file_sha256
from gsbench.scene.images import image_size, list_images, open_image, read_image, write_png
from gsbench.scene.names import match
from gsbench.scene.options import Backdrop
from gsbench.scene.record import Photograph
from gsbench.scene.rules import given
from gsbench.scene.types import ByteArray, Camera, CameraModel, Capture, Mask
from gsbench.scene.undistortion import as_colmap, grid, rays_through
from gsbench.words import listed, some_of

DEPTH = "depth"
MILLIMETRE = 0.001  # of a world in metres: the step of most sensors
Pixels = NDArray[Any]  # [H, W] or [H, W, C]
SUFFIX = ".png"
WHITE = np.uint8(255)
IMAGES, MASKS = "images", "masks"  # in the folder of `prepare_photograph`
NEARLY_ONE = 1 - 1e-6  # a mean of ones in float32 may round to less than 1


def find_masks(folder: Path, names: Sequence[str], setting: str = "scene.masks") -> dict[str, Path]:
    """The mask file in ``folder`` of each image: ``b.jpg.png`` (COLMAP's) or ``b.png``.

    Raises InputError naming the ``setting`` and the images without a mask.
    """
    found = {name: f"{name}{SUFFIX}" for name in names if (folder / f"{name}{SUFFIX}").is_file()}
    if missing := [name for name in names if name not in found]:
        found |= match(missing, list_images(folder))
    if missing := [name for name in names if name not in found]:
        raise InputError(
            f"{setting}: no mask of {some_of(missing)} in {folder}: add {missing[0]}{SUFFIX} "
            "(all white where every pixel counts)"
        )
    return {name: folder / found[name] for name in names}


def check_masks(rows: Sequence[Photograph]) -> None:
    """Raise InputError for a mask that is no image, or not of its photograph's size."""
    for row in rows:
        if row.mask is not None:
            size = image_size(row.mask)
            given(
                "mask-of-other-size",
                size != row.size,
                str(row.mask),
                name=row.name,
                size=f"{size[0]}x{size[1]}",
                full=f"{row.size[0]}x{row.size[1]}",
            )


def read_mask(path: Path, may_be_black: bool = False) -> Mask:
    """Read a mask [H, W]: False where the file is black.

    Raises InputError for a file that is no mask: with colours, with many greys, or black
    everywhere unless it ``may_be_black``.
    """
    with open_image(path, decode=True) as image:
        transparent = image.has_transparency_data
        if transparent and np.asarray(image.convert("RGBA"))[..., 3].min() < 255:
            raise InputError(
                f"{path}: a mask says by black what is ignored, not by transparency: save it as "
                "grey"
            )
        in_colors = image.mode in ("P", "CMYK", "YCbCr", "RGBA", "LA")
        pixels = np.asarray(image.convert("RGB") if in_colors else image)
    if pixels.ndim == 3:
        if (pixels != pixels[..., :1]).any():
            raise InputError(
                f"{path}: is in colours, and no mask: make it black where pixels are ignored, "
                "else white"
            )
        pixels = pixels.max(axis=2)
    mask: Mask = pixels != 0
    if not may_be_black:
        given("black-mask", float(mask.mean()), str(path))
    given("grey-mask", float((mask & (pixels != pixels.max())).mean()), str(path))
    return mask


def write_mask(mask: Mask, path: Path) -> None:
    """Write the mask as a PNG in black and white."""
    write_png(mask.astype(np.uint8) * WHITE, path)


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
        pixels = fill_ignored(pixels, mask)
    write_png(pixels, target, exif)


def prepared_mask(folder: Path, name: str) -> Path:
    """The file of the mask that `prepare_photograph` writes, as COLMAP names it."""
    return folder / MASKS / f"{name}{SUFFIX}"


def fill_ignored(image: ByteArray, mask: Mask) -> ByteArray:
    """``image`` [H, W, 3] with each ignored pixel as the counted pixel nearest to it.

    So there is no edge at the border of the mask where features would be detected.
    """
    from scipy.ndimage import distance_transform_edt  # slow to import

    nearest = distance_transform_edt(~mask, return_distances=False, return_indices=True)
    return image[tuple(nearest)]


def resize_mask(mask: Mask, width: int, height: int) -> Mask:
    """The mask at another size: a pixel counts if all original ones centred in its area count.

    The filters that resize photographs reach further than that. Beyond the mask's border they use
    the pixels that `fill_ignored` made.
    """
    if mask.shape == (height, width):
        return mask
    shares = Image.fromarray(mask.astype(np.float32)).resize((width, height), Image.Resampling.BOX)
    return np.asarray(shares) >= NEARLY_ONE


# ---- other pictures


def files_beside(capture: Capture, kinds: Sequence[str]) -> dict[str, Mapping[str, Path]]:
    """The files of each kind by photograph; raises InputError for a kind that none has."""
    for kind in kinds:
        if kind not in capture.beside:
            raise InputError(
                f"scene.beside={kind}: no photograph of {capture.images} has such a picture; there "
                f"are: {listed(sorted(capture.beside)) or 'none'}; put them into a folder beside "
                "the photographs', named like this and like a kind of picture (docs/captures.md)"
            )
    return {kind: capture.beside[kind] for kind in kinds}


def read_beside(path: Path, kind: str, depth_scale: float | None = None) -> Pixels:
    """The pixels of a file: depth in world units [H, W] float32, others uint8 [H, W, C].

    Depth is ``.npy`` with float32 values, or a picture of one channel; integers are steps of
    ``depth_scale`` world units (None: a thousandth). Values that are not finite and above 0 become
    0, which means that the depth is not known. Raises InputError for a file that cannot be read.
    """
    if kind != DEPTH:
        with open_image(path, decode=True) as image:
            return np.atleast_3d(np.asarray(image))
    if path.suffix.lower() == ".npy":
        try:
            values: Pixels = np.load(path, allow_pickle=False)
        except DAMAGE as error:
            raise InputError(f"{path}: is no array of numpy ({error}): save it again") from error
    else:
        with open_image(path, decode=True) as image:
            values = np.asarray(image)
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[..., 0]
    if values.ndim != 2 or values.dtype.kind not in "uif":
        raise InputError(
            f"{path}: a depth map has one number for each pixel, this has {values.dtype} "
            f"{list(values.shape)}: save it as 16-bit grey, 32-bit float TIFF, or .npy of height x "
            "width"
        )
    step = 1.0 if values.dtype.kind == "f" else depth_scale or MILLIMETRE
    depth = values.astype(np.float32) * np.float32(step)
    known = np.isfinite(depth) & (depth > 0)
    return np.where(known, depth, 0).astype(np.float32)


def resized(picture: Pixels, width: int, height: int) -> Pixels:
    """The nearest pixels of a picture [h, w, …] at another size in px: [height, width, …].

    Nothing is interpolated: a mean of two depths belongs to no surface.
    """
    rows = (np.arange(height) + 0.5) * picture.shape[0] / height
    columns = (np.arange(width) + 0.5) * picture.shape[1] / width
    return picture[np.ix_(rows.astype(int), columns.astype(int))]


def pixels_of_view(picture: Pixels, lens: CameraModel, view: Camera, source: Path) -> Pixels:
    """The pixels of ``picture`` [h, w, …] nearest to those of an undistorted view: [H, W, …].

    The picture covers the photograph of ``lens`` and may have another size. Pixels of the view that
    lie outside the photograph are 0. Raises InputError that names ``source``, the picture's file,
    if the picture has another shape.
    """
    height, width = picture.shape[:2]
    # Both sides of a smaller picture were rounded to whole pixels.
    if abs(width * lens.height - height * lens.width) > max(lens.width, lens.height):
        raise InputError(
            f"{source}: is {width}x{height} px, and its photograph {lens.width}x{lens.height}: "
            "give a picture of the whole photograph, of the same shape"
        )
    if not lens.distorted:
        return resized(picture, view.width, view.height)
    middles = [np.arange(side, dtype=np.float64) + 0.5 for side in (view.width, view.height)]
    pixels = grid(*middles)  # [H W, 2]
    rays = rays_through(pixels, *view.params)
    seen: Any = as_colmap(lens).img_from_cam(rays)  # [H W, 2] px
    places = seen / (lens.width, lens.height)  # in 0..1
    inside = ((places >= 0) & (places < 1)).all(axis=1)  # False for a ray without a place
    across, down = (np.where(inside[:, None], places, 0) * picture.shape[1::-1]).astype(int).T
    chosen = picture[down, across]
    chosen[~inside] = 0
    return chosen.reshape(view.height, view.width, *picture.shape[2:])


def view_of_file(
    path: Path, kind: str, lens: CameraModel, view: Camera, depth_scale: float | None = None
) -> Pixels:
    """`pixels_of_view` of the file ``path``, as `read_beside` reads it."""
    return pixels_of_view(read_beside(path, kind, depth_scale), lens, view, path)


def digests(files: Mapping[str, Mapping[str, Path]]) -> dict[str, dict[str, str]]:
    """sha256 of each file, by kind and photograph."""
    return {
        kind: {name: file_sha256(path) for name, path in sorted(own.items())}
        for kind, own in files.items()
    }
