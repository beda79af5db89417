"""Renders of two arms beside the photograph: the views with the least, the median and the largest gain."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gsbench.analysis.images import absolute_error, read_ignored, read_image, view_names
from gsbench.analysis.results import TrialResult
from gsbench.errors import InputError
from gsbench.runs.layout import GROUND_TRUTH, RENDERS

STRIPE, STRIPES = 4, (110, 150)  # px, grey levels: how ignored pixels are shown
WIDEST = 1200  # px: whole views are shown at most as wide
FULL_COLOUR = 32.0  # 8-bit levels: differences of error from here on have the strongest colour

Pair = tuple[TrialResult, TrialResult]


@dataclass(frozen=True)
class WholeView:
    """One test view: data URIs of the photograph, both renders and their difference, and the mean errors (levels).

    The difference is blue where the second arm is nearer to the photograph, red where the first is.
    """

    which: str  # of all views, such as "the view with the least gain"
    scene: str
    view: str
    seed: int
    truth: str
    first: str
    second: str
    difference: str
    first_error: float
    second_error: float


def choose_views(pairs: Sequence[Pair]) -> tuple[list[WholeView], list[str]]:
    """Choose the worst, the median and the best view of all, by gain; the second list says what could not be read.

    A view's gain is the mean error of the first arm minus that of the second. One seed of each scene is looked at.
    """
    views: list[tuple[float, Pair, str]] = []
    faults: dict[str, str] = {}  # by scene
    seen: set[str] = set()
    for one, other in pairs:
        if one.scene in seen:
            continue
        try:
            for view in view_names(one):
                first, second, truth = _read(one, other, view)
                gain = absolute_error(first, truth).mean() - absolute_error(second, truth).mean()
                views.append((float(gain), (one, other), view))
            seen.add(one.scene)
        except InputError as error:
            faults.setdefault(one.scene, str(error))
    return [_whole(which, *place) for which, place in _worst_median_best(views)], list(faults.values())


def _worst_median_best(views: Sequence[tuple[float, Pair, str]]) -> list[tuple[str, tuple[Pair, str]]]:
    """The views with the least, the median and the largest gain, each once."""
    ordered = sorted(views, key=lambda entry: (entry[0], entry[1][0].label, entry[2]))
    if len(ordered) < 2:
        return [("the only view", entry[1:]) for entry in ordered]
    chosen = [("the view with the least gain", ordered[0]), ("the view with the largest gain", ordered[-1])]
    if len(ordered) > 2:
        chosen.insert(1, ("the view with the median gain", ordered[len(ordered) // 2]))
    return [(which, entry[1:]) for which, entry in chosen]


def _whole(which: str, pair: Pair, view: str) -> WholeView:
    first, second, truth = _read(*pair, view)
    errors = [absolute_error(image, truth) for image in (first, second)]  # [H, W] each
    part = np.clip((errors[0] - errors[1]) / FULL_COLOUR, -1, 1)[..., None]  # [H, W, 1], 1 where the second is nearer
    white, blue, red = (np.array(colour) for colour in ((255, 255, 255), (33, 102, 172), (178, 24, 43)))
    colours = white + np.abs(part) * (np.where(part > 0, blue, red) - white)
    return WholeView(
        which,
        pair[0].scene,
        view,
        pair[0].seed,
        truth=_jpeg_uri(truth),
        first=_jpeg_uri(first),
        second=_jpeg_uri(second),
        difference=_jpeg_uri(colours.round().astype(np.uint8)),
        first_error=float(errors[0].mean()),
        second_error=float(errors[1].mean()),
    )


def _jpeg_uri(image: NDArray[np.uint8]) -> str:
    """A JPEG of [H, W, 3] as a data URI: whole pictures as PNG would make the page ten times as large."""
    picture = Image.fromarray(image)
    picture.thumbnail((WIDEST, WIDEST))
    buffer = io.BytesIO()
    picture.save(buffer, format="JPEG", quality=92, subsampling=0)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def data_uri(image: NDArray[np.uint8]) -> str:
    """A lossless PNG of [H, W, 3] as a data URI."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def _read(one: TrialResult, other: TrialResult, view: str) -> list[NDArray[np.uint8]]:
    """Both renders and the photograph, ignored pixels striped."""
    first = read_image(one.path / RENDERS / f"{view}.png")
    second = read_image(other.path / RENDERS / f"{view}.png")
    truth = read_image(one.path / GROUND_TRUTH / f"{view}.png")
    if not first.shape == second.shape == truth.shape:
        raise InputError(f"{one.label} and {other.label}: {view} has different sizes")
    ignored = read_ignored(one, view)
    images = [first, second, truth]
    return images if ignored is None else [_hatched(image, ignored) for image in images]


def _hatched(image: NDArray[np.uint8], ignored: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """``image`` with stripes on ignored pixels, which are thus equal in all images."""
    rows, columns = np.indices(ignored.shape)
    stripes = np.where((rows + columns) % (2 * STRIPE) < STRIPE, *STRIPES).astype(np.uint8)  # [H, W]
    return np.where(ignored[..., None], stripes[..., None], image)
