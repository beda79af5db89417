"""The places where two arms differ most, cut out of their renders and of the ground truth."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gsbench.analysis.errors_by_region import absolute_error, read_ignored, read_image, view_names
from gsbench.analysis.results import TrialResult
from gsbench.errors import InputError
from gsbench.runs.layout import GROUND_TRUTH, RENDERS

CROP = 128  # px a side, but at most a third of the image
STRIPE, STRIPES = 4, (110, 150)  # px, grey levels: how ignored pixels are shown
SHOWN = 288  # px: crops are enlarged to it without smoothing, so that pixels stay pixels


@dataclass(frozen=True)
class Crop:
    """One place: data URIs of both renders and the truth, and the mean errors in it (8-bit levels)."""

    scene: str
    view: str
    seed: int
    box: tuple[int, int, int, int]  # left, top, right, bottom, px
    first: str
    second: str
    truth: str
    first_error: float
    second_error: float
    striped: bool = False  # some of its pixels, which a mask ignores


def choose_crops(
    pairs: Sequence[tuple[TrialResult, TrialResult]], count: int
) -> tuple[list[Crop], list[Crop], list[str]]:
    """Choose up to ``count`` places each where the second arm gains and loses most; also lists what cannot be read.

    One seed of each scene is looked at, and at most one place in a view is taken for each list.
    """
    places: list[tuple[float, tuple[TrialResult, TrialResult], str, tuple[int, int, int, int]]] = []
    faults: dict[str, str] = {}  # by scene
    seen: set[str] = set()
    for one, other in pairs:
        if one.scene in seen:
            continue
        try:
            names = view_names(one)
            for view in names:
                images, _ = _read(one, other, view)
                places += [(gain, (one, other), view, box) for gain, box in _extremes(*images)]
            seen.add(one.scene)
        except InputError as error:
            faults.setdefault(one.scene, str(error))
    best = sorted((place for place in places if place[0] > 0), key=lambda place: -place[0])[:count]
    worst = sorted((place for place in places if place[0] < 0), key=lambda place: place[0])[:count]
    return [_cut(*place[1:]) for place in best], [_cut(*place[1:]) for place in worst], list(faults.values())


def data_uri(image: NDArray[np.uint8]) -> str:
    """A lossless PNG of [H, W, 3] as a data URI."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def _read(one: TrialResult, other: TrialResult, view: str) -> tuple[list[NDArray[np.uint8]], NDArray[np.bool_] | None]:
    """Both renders and the photograph, ignored pixels striped, and which these are (None: all count)."""
    first = read_image(one.path / RENDERS / f"{view}.png")
    second = read_image(other.path / RENDERS / f"{view}.png")
    truth = read_image(one.path / GROUND_TRUTH / f"{view}.png")
    if not first.shape == second.shape == truth.shape:
        raise InputError(f"{one.label} and {other.label}: {view} has different sizes")
    ignored = read_ignored(one, view)
    images = [first, second, truth]
    return (images if ignored is None else [_hatched(image, ignored) for image in images]), ignored


def _hatched(image: NDArray[np.uint8], ignored: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """``image`` with stripes on ignored pixels, which are thus equal in all images."""
    rows, columns = np.indices(ignored.shape)
    stripes = np.where((rows + columns) % (2 * STRIPE) < STRIPE, *STRIPES).astype(np.uint8)  # [H, W]
    return np.where(ignored[..., None], stripes[..., None], image)


def _extremes(
    first: NDArray[np.uint8], second: NDArray[np.uint8], truth: NDArray[np.uint8]
) -> list[tuple[float, tuple[int, int, int, int]]]:
    """The boxes of largest and smallest mean gain of the second image in a view."""
    from skimage.transform import integral_image  # here, since it is slow to import

    gain = absolute_error(first, truth) - absolute_error(second, truth)  # [H, W]
    height = width = max(1, min(CROP, min(gain.shape) // 3))
    sums = np.pad(integral_image(gain), ((1, 0), (1, 0)))  # [H + 1, W + 1]
    boxes = sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width] + sums[:-height, :-width]
    found = []
    for place in (int(boxes.argmax()), int(boxes.argmin())):
        top, left = divmod(place, boxes.shape[1])
        found.append((float(boxes[top, left]) / (height * width), (left, top, left + width, top + height)))
    return found


def _cut(pair: tuple[TrialResult, TrialResult], view: str, box: tuple[int, int, int, int]) -> Crop:
    left, top, right, bottom = box
    whole, ignored = _read(*pair, view)
    images = [image[top:bottom, left:right] for image in whole]
    errors = [float(absolute_error(image, images[2]).mean()) for image in images[:2]]
    uris = [data_uri(_enlarge(image)) for image in images]
    striped = ignored is not None and bool(ignored[top:bottom, left:right].any())
    return Crop(pair[0].scene, view, pair[0].seed, box, uris[0], uris[1], uris[2], errors[0], errors[1], striped)


def _enlarge(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    factor = max(1, SHOWN // max(image.shape[:2]))
    return image.repeat(factor, axis=0).repeat(factor, axis=1)
