"""Facts of the initial points before the first iteration of a training, and their judgement.

A cloud in other coordinates or a point far outside would not stop a training, but its results would
mean nothing (`gsbench.scene.rules`, stage cloud). The facts are kept with the results.
"""

from types import SimpleNamespace

import numpy as np
from numpy.typing import NDArray

from gsbench.normalization import IDENTITY, Normalization
from gsbench.raster.base import CONSTANTS
from gsbench.runs.trial_record import InitialCloud, Oddity
from gsbench.scene.rules import camera_distances, inspect
from gsbench.scene.types import Array, Scene, View

# Points that are measured, evenly spaced in the cloud's order; the check takes about a second.
MAX_POINTS = 20_000
# Lengths are over the median distance of the training cameras from their median place.
FAR = 1e4  # photographs do not determine the depth of a point so far away
MIN_COLOR_SPREAD = 1.0  # levels of 255; the colours of a cloud of one colour say nothing


def check_start(
    points: Array,
    colors: NDArray[np.uint8],
    scene: Scene,
    random_points: bool = False,
    normalization: Normalization = IDENTITY,
    accept: tuple[str, ...] = (),
) -> tuple[InitialCloud, tuple[Oddity, ...]]:
    """Compare the initial ``points`` [P, 3] and ``colors`` [P, 3] with the training views.

    Returns facts, and what is odd about them, which is logged. Positions are those of the training;
    messages undo ``normalization``. If ``random_points``, points and colours were drawn at random
    and need not fit the photographs.

    Raises InputError if nothing can be learnt from such a start, unless the rule is in ``accept``.
    """
    middle, from_middle = camera_distances([view.camera for view in scene.train])
    # A single far camera changes the extent, but not the median distance. The median is 0 if most
    # cameras are at one place.
    size = float(np.median(from_middle)) or scene.extent or 1.0
    distances = np.linalg.norm(points - middle, axis=1) / size  # [P]
    farthest = int(distances.argmax())
    chosen = np.linspace(0, len(points) - 1, min(len(points), MAX_POINTS)).astype(np.int64)
    seen_by, shown = _views_of(points[chosen], scene.train)
    facts = InitialCloud(
        seen=float((seen_by >= 2).mean()),
        color_agreement=_agreement(colors[chosen], shown),
        identical=_identical_share(points),
        far=int((distances > FAR).sum()),
        spread=float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)) / size),
    )
    # the quantities that the rules measure; None is not measured
    start = SimpleNamespace(
        **vars(facts),
        extent=scene.extent,
        farthest=float(distances[farthest]),
        number=farthest,
        total=len(points),
        place=_place(points[farthest], normalization),
        seen_by_one=float(seen_by.any()),
        first_place=_place(points[0], normalization),
        color_spread=float(colors.std(axis=0).max()),
        first_color=tuple(colors[0].tolist()),
    )
    if random_points:
        start.seen = start.spread = start.color_agreement = start.color_spread = None
    return facts, inspect("cloud", start, f"scene {scene.name}", accept)


def _place(point: Array, normalization: Normalization) -> str:
    """The position of ``point`` in the scene's own coordinates, as text for a message."""
    return f"({', '.join(f'{value:.9g}' for value in normalization.undo(point))})"


def _identical_share(points: Array) -> float:
    """The share of ``points`` [P, 3] that have the same float32 position as another point."""
    places = np.ascontiguousarray(points.astype(np.float32)).view("V12").ravel()
    _, counts = np.unique(places, return_counts=True)
    return float(counts[counts > 1].sum() / len(points))


def _views_of(
    points: Array, views: tuple[View, ...]
) -> tuple[NDArray[np.int64], NDArray[np.int16]]:
    """The number of views of each point, [P], and its colour in the nearest view, [P, 3].

    A point is in view if it is beyond the near plane and within the image. Occlusion is ignored; in
    the nearest view it is least likely. The colour is -1 for points that no view shows; pixels that
    a mask ignores have no colour.
    """
    seen_by = np.zeros(len(points), dtype=np.int64)
    shown = np.full((len(points), 3), -1, dtype=np.int16)
    nearest = np.full(len(points), np.inf)
    for view in views:
        camera = view.camera
        local = points @ camera.rotation.T + camera.translation  # [P, 3]
        (ahead,) = np.nonzero(local[:, 2] > CONSTANTS.near)
        x, y, z = local[ahead].T
        column, row = np.floor([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])
        inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        seen = ahead[inside]
        column = column[inside].astype(np.int64)
        row = row[inside].astype(np.int64)
        seen_by[seen] += 1
        distance = np.linalg.norm(local[seen], axis=1)
        is_nearer = distance < nearest[seen]
        if view.mask is not None:
            is_nearer &= view.mask[row, column]
        shown[seen[is_nearer]] = view.image[row[is_nearer], column[is_nearer]]
        nearest[seen[is_nearer]] = distance[is_nearer]
    return seen_by, shown


def _agreement(colors: NDArray[np.uint8], shown: NDArray[np.int16]) -> float | None:
    """The agreement of the points' ``colors`` [P, 3] with those ``shown`` in the photographs.

    ``shown`` [P, 3] is -1 for points without such a colour. The agreement is 1 minus the mean
    difference of both colours, divided by the mean difference over all pairs of points: 1 is equal,
    0 is chance. It is None if the points or the photographs have only one colour, or if fewer than
    two points are shown.
    """
    is_shown = shown[:, 0] >= 0
    own, photograph = colors[is_shown].astype(np.int64), shown[is_shown].astype(np.int64)  # [S, 3]
    if len(own) < 2 or min(own.std(axis=0).max(), photograph.std(axis=0).max()) < MIN_COLOR_SPREAD:
        return None
    levels = np.arange(256)
    apart = np.abs(levels[:, None] - levels)  # [256, 256]
    # the mean difference over all pairs of a point and a shown colour, from histograms of channels
    chance = 0.0
    for channel in range(3):
        counts, counts_shown = (
            np.bincount(x[:, channel], minlength=256) / len(own) for x in (own, photograph)
        )
        chance += counts @ apart @ counts_shown / 3
    return float(1 - np.abs(own - photograph).mean() / chance)
