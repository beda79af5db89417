"""Pictures of test views: the error in textured parts, and two arms' renders side by side."""

import base64
import io
import itertools
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gsbench.analysis.results import TrialPair, TrialResult
from gsbench.errors import InputError
from gsbench.parsing import Number, Record, read_if_sound
from gsbench.runs.layout import FROM_PIXELS, GROUND_TRUTH, MASKS, REGIONS, RENDERS
from gsbench.scene.beside import read_mask
from gsbench.scene.images import read_image

SIDE = 32  # px, of a region
TEXTURE_SIGMA = 2.0  # px: the Gaussian over which the squared gradient is averaged
LUMINANCE = (0.2126, 0.7152, 0.0722)  # Rec. 709
TEXTURED_SHARE = 0.2  # share of a photograph's pixels that count as textured
STRIPE, STRIPES = 4, (110, 150)  # px, grey levels: stripes over ignored pixels
WIDEST = 1200  # px: largest width and height of a shown view
FULL_COLOUR = 32.0  # 8-bit levels: difference of error that has the strongest colour

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]  # [H, W, 3]


def texture_energy(image: Pixels) -> Array:
    """The local mean [H, W] of an image's squared luminance gradient, in 8-bit levels²."""
    from skimage.filters import gaussian  # here, since it is slow to import

    luminance = image.astype(np.float64) @ np.array(LUMINANCE)  # [H, W]
    rows, columns = np.gradient(luminance)
    return gaussian(rows**2 + columns**2, TEXTURE_SIGMA, mode="reflect", preserve_range=True)


def read_view(trial: TrialResult, view: str) -> tuple[Pixels, Pixels, NDArray[np.bool_]]:
    """A test view's render and photograph, and the pixels [H, W] that count.

    These are those that its mask keeps, or all. Raises InputError if the sizes differ.
    """
    render, truth = (
        read_image(trial.path / kind / f"{view}.png") for kind in (RENDERS, GROUND_TRUTH)
    )
    if render.shape != truth.shape:
        raise InputError(f"{trial.label}: {view} has different sizes")
    mask = trial.path / MASKS / f"{view}.png"
    counted = read_mask(mask) if mask.is_file() else np.ones(truth.shape[:2], dtype=bool)
    return render, truth, counted


def absolute_error(render: Pixels, truth: Pixels) -> Array:
    """Mean absolute difference over channels, [H, W], in 8-bit levels."""
    return np.abs(render.astype(np.float64) - truth.astype(np.float64)).mean(axis=-1)


class PixelMeasures(Record):
    """Measures of a trial's pictures, which an archive stores in place of the pictures."""

    error_textured: Number


def textured_error(trial: TrialResult) -> float:
    """The mean error (8-bit levels) in the most textured fifth of each test photograph.

    It is averaged over views. This fifth shows grass, foliage, fabric or gravel. Raises
    InputError if neither renders nor their stored measure exist.
    """
    stored = read_if_sound(trial.path / FROM_PIXELS, PixelMeasures)
    if stored is not None:
        return stored.error_textured
    errors = []
    for view in view_names(trial):
        render, truth, counted = read_view(trial, view)
        texture = texture_energy(truth)  # [H, W]
        inside = counted & (texture >= np.quantile(texture[counted], 1 - TEXTURED_SHARE))
        errors.append(absolute_error(render, truth)[inside].mean())
    return float(np.mean(errors))


def region_errors(render: Pixels, truth: Pixels) -> Array:
    """The mean squared error [R, C] in the regions of two 8-bit images [H, W, 3], in levels².

    Regions at the right and lower border are smaller if 32 does not divide the sides; narrower
    than half a region, they belong to their neighbour.
    """
    # whole numbers, since reports read hundreds of pictures
    squared = (render.astype(np.int32) - truth) ** 2
    return region_means(squared.sum(axis=-1) / squared.shape[-1])


def region_means(values: Array) -> Array:
    """The means [R, C] of a picture [H, W] over the regions of `region_errors`."""
    starts = [np.arange(max(1, round(size / SIDE))) * SIDE for size in values.shape]
    sums, counts = values, np.ones_like(values)
    for axis, first in enumerate(starts):
        sums, counts = (np.add.reduceat(each, first, axis) for each in (sums, counts))
    return sums / counts


class RegionErrors(Record):
    """``regions.json`` in an archive: mean squared errors [R][C] of regions by view."""

    views: dict[str, list[list[Number]]]


def regions_of(trial: TrialResult) -> Mapping[str, Array]:
    """The mean squared errors [R, C] in regions of each test view, in 8-bit levels².

    Masked pixels have no error. Raises InputError if neither pictures nor stored errors exist.
    """
    stored = read_if_sound(trial.path / REGIONS, RegionErrors)
    if stored is not None:
        return {view: np.array(rows, dtype=float) for view, rows in stored.views.items()}
    errors = {}
    for view in view_names(trial):
        render, truth, counted = read_view(trial, view)
        errors[view] = region_errors(np.where(counted[..., None], render, truth), truth)
    return errors


def region_record(trial: TrialResult) -> RegionErrors:
    """The errors of a trial's regions, with six digits, for an archive."""
    rounded = {
        view: [[float(f"{error:.6g}") for error in row] for row in errors]
        for view, errors in regions_of(trial).items()
    }
    return RegionErrors(views=rounded)


def view_names(trial: TrialResult) -> list[str]:
    """The names of the rendered test views, sorted; raises ``InputError`` if there are none."""
    folder = trial.path / RENDERS
    names = sorted(path.stem for path in folder.glob("*.png"))
    if not names:
        raise InputError(f"{trial.label} holds no {RENDERS}")
    return names


@dataclass(frozen=True)
class ViewComparison:
    """One test view of two arms: data URIs of its pictures, mean errors in 8-bit levels.

    The difference is blue where the second arm is nearer to the photograph, red where the first arm
    is.
    """

    which: str  # such as "the view with the least gain"
    scene: str
    view: str
    seed: int
    truth: str
    first: str
    second: str
    difference: str
    first_error: float
    second_error: float


def choose_views(pairs: Sequence[TrialPair]) -> tuple[list[ViewComparison], list[str]]:
    """The views with the least, the median and the largest gain, and messages on faults.

    A view's gain is the first arm's mean error minus the second arm's. Of each scene, one seed is
    used: the first whose pictures can be read.
    """
    gains: dict[str, list[tuple[float, str, str, TrialPair]]] = {}  # by scene
    faults: dict[str, str] = {}
    for pair in pairs:
        scene = pair[0].scene
        try:
            for view in () if scene in gains else view_names(pair[0]):
                first, second, truth = read_compared(*pair, view)
                errors = (absolute_error(image, truth).mean() for image in (first, second))
                gain = float(next(errors) - next(errors))
                gains.setdefault(scene, []).append((gain, pair[0].label, view, pair))
        except InputError as error:
            gains.pop(scene, None)
            faults.setdefault(scene, str(error))
    ordered = sorted(itertools.chain(*gains.values()))
    last = len(ordered) - 1
    # of two views, the second is the one with the largest gain, and not the median
    named = {0: "least", len(ordered) // 2: "median", last: "largest"} if ordered else {}
    chosen = [
        compare_view(f"the view with the {word} gain", pair, view)
        for place, word in named.items()
        for _, _, view, pair in [ordered[place]]
    ]
    return chosen, list(faults.values())


def compare_view(which: str, pair: TrialPair, view: str) -> ViewComparison:
    """A test view of a pair of trials as the report shows it.

    Raises InputError if its pictures differ in size.
    """
    first, second, truth = read_compared(*pair, view)
    errors = [absolute_error(image, truth) for image in (first, second)]  # [H, W] each
    nearer = np.clip((errors[0] - errors[1]) / FULL_COLOUR, -1, 1)  # [H, W], above 0: the second is
    gain = nearer[..., None]  # [H, W, 1]
    white, blue, red = (
        np.array(colour) for colour in ((255, 255, 255), (33, 102, 172), (178, 24, 43))
    )
    colours = white + np.abs(gain) * (np.where(gain > 0.0, blue, red) - white)
    return ViewComparison(
        which,
        pair[0].scene,
        view,
        pair[0].seed,
        truth=jpeg_uri(truth),
        first=jpeg_uri(first),
        second=jpeg_uri(second),
        difference=jpeg_uri(colours.round().astype(np.uint8)),
        first_error=float(errors[0].mean()),
        second_error=float(errors[1].mean()),
    )


def jpeg_uri(image: NDArray[np.uint8]) -> str:
    """A picture as a JPEG data URI; PNG would make the page ten times as large."""
    picture = Image.fromarray(image)
    picture.thumbnail((WIDEST, WIDEST))
    buffer = io.BytesIO()
    picture.save(buffer, format="jpeg", quality=92, subsampling=0)
    return f"data:image/jpeg;base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"


def read_truth(trial: TrialResult, view: str) -> Pixels | None:
    """The photograph of a test view; None if it is not there."""
    with suppress(InputError):
        return read_image(trial.path / GROUND_TRUTH / f"{view}.png")
    return None


def read_compared(one: TrialResult, other: TrialResult, view: str) -> list[Pixels]:
    """Both renders and the photograph of a view, [H, W, 3] each.

    Ignored pixels have the same stripes in all three, so they show no error. Raises InputError
    if the sizes differ.
    """
    first, truth, counted = read_view(one, view)
    second = read_image(other.path / RENDERS / f"{view}.png")
    if second.shape != truth.shape:
        raise InputError(f"{one.label} and {other.label}: {view} has different sizes")
    rows, columns = np.indices(counted.shape)
    is_first = (rows + columns) % (2 * STRIPE) < STRIPE  # [H, W]
    stripes = np.where(is_first, *STRIPES).astype(np.uint8)  # [H, W]
    return [
        np.where(counted[..., None], image, stripes[..., None]) for image in (first, second, truth)
    ]
