"""Pictures of views on disk: how renders and photographs are read, what is odd, their metrics.

Photographs of a capture are read by `gsbench.scene.images.read_image`. A render is the result of a
measurement, so nothing is blended or cut here, and what lowers its values is told.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsbench.errors import InputError
from gsbench.eval.evaluator import Evaluator
from gsbench.files import DAMAGE
from gsbench.logs import Progress, no_progress
from gsbench.runs.trial_record import Oddity
from gsbench.scene.beside import read_mask
from gsbench.scene.images import EXIF_ORIENTATION, SIXTEEN_BIT_MODES, open_image, read_image
from gsbench.scene.rules import Finding, inspect

# A view of so many pixels takes half a minute; a file of some kB may claim more.
MAX_PIXELS = 64_000_000
GREY_MODES = ("1", "L", "LA", *SIXTEEN_BIT_MODES)
UPRIGHT = (0, 1)  # EXIF orientations; 0 is written by some cameras for none
LOSSY_WEBP = b"VP8 "  # the first chunk of a WebP file without alpha that is compressed with loss


@dataclass(frozen=True)
class Look:
    """The facts about a picture that its file tells, before its pixels are used."""

    size: tuple[int, int] = (0, 0)  # px, width and height
    mode: str = "RGB"  # Pillow's name of the kind of pixels
    lossy: bool = False
    sixteen_bits: bool = False  # in each channel
    transparent: bool = False  # some pixel is
    orientation: int = 1  # EXIF

    @property
    def is_grey(self) -> bool:
        return self.mode in GREY_MODES


def look_at(path: Path) -> Look:
    """Look at a picture; raises `InputError` if it is missing, damaged or no image."""
    with open_image(path) as image:
        codecs = [str(tile.args) for tile in getattr(image, "tile", ())]  # such as RGB;16B
        wide = image.mode.startswith("I;16") or any(";16" in codec for codec in codecs)
        with path.open("rb") as file:
            is_webp = file.read(16)[12:] == LOSSY_WEBP
        try:
            orientation = int(image.getexif().get(EXIF_ORIENTATION, 1))
            transparent = image.has_transparency_data
            if transparent:
                alphas = np.asarray(image.convert("RGBA").getchannel("A"))
                transparent = bool((alphas < 255).any())
        except DAMAGE as error:
            raise InputError(
                f"{path}: the image is damaged ({error}): replace or remove it"
            ) from error
        lossy = image.format in ("JPEG", "MPO") or is_webp
        return Look(image.size, image.mode, lossy, wide, transparent, orientation)


def read_picture(path: Path, is_render: bool) -> NDArray[np.uint8]:
    """A render or a photograph as [H, W, 3] uint8 RGB.

    16-bit values are rounded to the nearest of 255 levels. The colours of a transparent render are
    taken as they are; a transparent photograph is blended over black. Raises `InputError` as
    `read_image` does.
    """
    look, pixels = look_at(path), read_image(path)
    if look.transparent and is_render:
        with open_image(path) as image:
            return np.array(image.convert("RGBA"), dtype=np.uint8)[..., :3]
    if look.sixteen_bits and not look.transparent:
        import pycolmap  # Pillow keeps the high bytes of 16-bit colours, and has lost the low ones

        rounded = pycolmap.Bitmap.read(path, as_rgb=True)
        return pixels if rounded is None else np.array(rounded.to_array(), dtype=np.uint8)
    return pixels


# Tests of a render and its photograph, by the ids of the rules about pictures
ODD: Mapping[str, Callable[[Look, Look], bool]] = {
    "transparent-render": lambda render, _: render.transparent,
    "lossy-render": lambda render, _: render.lossy,
    "palette-render": lambda render, _: render.mode == "P",
    "grey-render": lambda render, truth: render.is_grey and not truth.is_grey,
    "turned": lambda render, truth: (
        (render.orientation in UPRIGHT) != (truth.orientation in UPRIGHT)
    ),
    "transparent-photograph": lambda _, truth: truth.transparent,
}


@dataclass(frozen=True)
class PicturePair:
    """A view with the files of its photograph, its rendered picture and its mask, if any."""

    view: str
    photograph: Path
    picture: Path
    mask: Path | None = None


def check_pairs(pairs: Sequence[PicturePair], where: str) -> tuple[Oddity, ...]:
    """Look at all pictures, which are from ``where``, before any is measured.

    Logs and returns what is odd: one line for each rule that applies to some views. Raises
    `InputError` for a picture whose size differs from its photograph's, or is too large: pictures
    are never resized.
    """
    found: dict[str, list[Finding]] = {rule: [] for rule in ODD}
    for pair in pairs:
        render, truth = look_at(pair.picture), look_at(pair.photograph)
        (width, height), wanted = render.size, truth.size
        if render.size != wanted:
            turned = f"; it is stored on its side (EXIF orientation {truth.orientation}): turn it"
            raise InputError(
                f"{pair.picture} is {width}x{height} px, but its photograph {pair.photograph} "
                f"{wanted[0]}x{wanted[1]}: sizes are never changed here, so render at the "
                f"photographs' size{'' if truth.orientation in UPRIGHT else turned}"
            )
        if width * height > MAX_PIXELS:
            raise InputError(
                f"{pair.picture} is {width}x{height} px: pictures of more than "
                f"{MAX_PIXELS / 1e6:g} megapixels are not measured; render and shrink both"
            )
        for rule, applies in ODD.items():
            if applies(render, truth):
                found[rule].append(Finding(1, [pair.view]))
    return inspect("pictures", found, where)


def measure(
    pairs: Sequence[PicturePair], evaluator: Evaluator, report: Progress = no_progress
) -> dict[str, dict[str, float]]:
    """The metrics of every view, in the pairs' order.

    The pairs were checked (`check_pairs`). Raises `InputError` for damaged files.
    """
    per_view = {}
    for done, pair in enumerate(pairs, 1):
        mask = None if pair.mask is None else read_mask(pair.mask)
        render, truth = read_picture(pair.picture, True), read_picture(pair.photograph, False)
        per_view[pair.view] = evaluator.evaluate_view(render, truth, mask)
        report("views", done, len(pairs))
    return per_view
