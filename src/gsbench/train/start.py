"""Checks of the initial points and the cameras before the first iteration of a training.

A cloud in other coordinates, a point far outside, or a camera far from the others would not stop a
training, but its results would mean nothing. Each of these is an error or a warning here. The
measured facts are kept with the results.
"""

from __future__ import annotations

import logging
import math
from collections import defaultdict
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gsbench.errors import InputError
from gsbench.normalization import IDENTITY, Normalization
from gsbench.raster.base import CONSTANTS
from gsbench.runs.trial_record import InitialCloud
from gsbench.scene.types import Array, Camera, Scene, View
from gsbench.words import counted, some_of

log = logging.getLogger(__name__)

# Points that are measured, evenly spaced in the cloud's order; the check takes about a second.
MAX_POINTS = 20_000
# Lengths are over the median distance of the training cameras from their median place.
FAR = 1e4  # photographs do not determine the depth of a point so far away
MAX_DISTANCE = 1e7  # squares of larger lengths leave the range in which float32 can train
# Limits of the warnings. Clouds by structure from motion have a share of 0.97 or more in view and a
# colour agreement of 0.6 to 0.9; a cloud of another scene or with turned axes has an agreement of
# -0.1 to 0.2.
MIN_SEEN = 0.1
MIN_AGREEMENT = 0.25
MAX_IDENTICAL = 0.5
MIN_SPREAD = 0.02
MIN_COLOR_SPREAD = 1.0  # levels of 255; the colours of a cloud of one colour say nothing
MAX_FIELD_OF_VIEW = 150.0  # degrees; the widest pinhole lenses have 130
MIN_FIELD_OF_VIEW = 0.2  # degrees; satellites have 1 or 2
MAX_PIXEL_RATIO = 1.25  # of the focal lengths in x and y; unequal scaling of photographs gives 1.01
CENTRAL = (0.1, 0.9)  # range of the principal point of an uncropped photograph, as shares of a side
DARK = 48  # of 255: the brightest value of photographs that do not use their range
FAR_CAMERA = 20.0  # times the median distance of the training cameras from their median place


def check_start(
    points: Array,
    colors: NDArray[np.uint8],
    scene: Scene,
    random_points: bool = False,
    normalization: Normalization = IDENTITY,
) -> InitialCloud:
    """Compare the initial ``points`` [P, 3] and ``colors`` [P, 3] with the training views.

    Logs warnings for values beyond the limits above. Positions are those of the training; messages
    undo ``normalization``. If ``random_points``, points and colours were drawn at random and need
    not fit the photographs.

    Raises InputError if nothing can be learnt from such a start.
    """
    if scene.extent == 0:
        raise InputError(
            f"scene {scene.name}: all training cameras stand at one place, so no depth can be "
            "learnt: take photographs from several places"
        )
    warnings = far_cameras(scene) + odd_lenses(scene) + dark_photographs(scene)
    _warn(scene, warnings)  # before the errors below, because they may explain an error
    middle, from_middle = camera_distances(scene)
    # A single far camera changes the extent, but not the median distance. The median is 0 if most
    # cameras are at one place.
    size = float(np.median(from_middle)) or scene.extent
    distances = np.linalg.norm(points - middle, axis=1) / size  # [P]
    farthest = int(distances.argmax())
    if not distances[farthest] <= MAX_DISTANCE:
        raise InputError(
            f"initial point {farthest} of {len(points):,} is {distances[farthest]:.3g} times as "
            "far from the cameras as they are from each other, at "
            f"{_place(points[farthest], normalization)}: remove it from the cloud"
        )
    identical = _identical_share(points)
    if identical == 1.0:
        place = _place(points[0], normalization)
        raise InputError(f"the initial points are all at one place, {place}: rebuild the cloud")
    chosen = np.linspace(0, len(points) - 1, min(len(points), MAX_POINTS)).astype(np.int64)
    seen_by, shown = _views_of(points[chosen], scene.train)
    if not seen_by.any():
        raise InputError(
            "no training view has one of the initial points in view: the cloud lies in other "
            "coordinates than the cameras; bring it into theirs"
        )
    facts = InitialCloud(
        seen=float((seen_by >= 2).mean()),
        color_agreement=_agreement(colors[chosen], shown),
        identical=identical,
        far=int((distances > FAR).sum()),
        spread=float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)) / size),
        warnings=[],
    )
    doubts = _doubts(facts, random_points)
    if not random_points and colors.std(axis=0).max() < MIN_COLOR_SPREAD:
        shade = ", ".join(str(level) for level in colors[0])
        doubts.append(
            f"all initial points have the colour ({shade}): export the cloud with its colours"
        )
    _warn(scene, doubts)
    return replace(facts, warnings=warnings + doubts)


def _warn(scene: Scene, lines: list[str]) -> None:
    for line in lines:
        log.warning("scene %s: %s", scene.name, line)


def _doubts(facts: InitialCloud, random_points: bool) -> list[str]:
    """The warnings about a cloud with these facts."""
    lines = []
    if facts.far:
        far = counted(facts.far, "initial point")
        lines.append(f"{far} more than {FAR:,.0f} times as far off as the cameras: clean the cloud")
    if facts.identical > MAX_IDENTICAL:
        lines.append(
            f"{facts.identical:.0%} of the initial points share their place with another: thin "
            "the cloud"
        )
    if random_points:
        return lines
    elsewhere = "the cloud may lie in other coordinates, or have another scale, than the cameras"
    if facts.seen < MIN_SEEN:
        lines.append(
            f"only {facts.seen:.1%} of the initial points are in view of two training views: "
            f"{elsewhere}"
        )
    if facts.spread < MIN_SPREAD:
        lines.append(
            f"half of the initial points lie within {facts.spread:.2g} of the cameras' distances: "
            f"{elsewhere}"
        )
    if facts.color_agreement is not None and facts.color_agreement < MIN_AGREEMENT:
        lines.append(
            "the colours of the initial points hardly agree with the photographs (agreement "
            f"{facts.color_agreement:.2f}; 0 is chance, 1 is equal): {elsewhere}"
        )
    return lines


def far_cameras(scene: Scene) -> list[str]:
    """A warning for each training camera far from the others.

    3DGS takes the scene extent, and with it rates and sizes, from the farthest camera. Global
    structure from motion sometimes leaves a camera far off.
    """
    _, distances = camera_distances(scene)
    typical = float(np.median(distances))
    return [
        f"the camera of {view.name} is {distance / typical:,.0f} times as far from the others as "
        f"they usually are, and sets the scene extent to {scene.extent:.4g}: check its pose, or "
        "leave the image out"
        for view, distance in zip(scene.train, distances, strict=True)
        if distance > FAR_CAMERA * typical > 0
    ]


def dark_photographs(scene: Scene) -> list[str]:
    """A warning if all photographs are nearly black, so that metrics say little.

    The usual cause are values of 10 or 12 bits in files of 16.
    """
    brightest = max(int(view.image.max()) for view in scene.train)
    if brightest > DARK:
        return []
    return [f"no photograph has a value above {brightest} of 255: scale them to their full range"]


def odd_lenses(scene: Scene) -> list[str]:
    """A warning for each way in which intrinsics differ from those of common lenses.

    The usual cause is a value in another unit.
    """
    names: dict[str, list[str]] = defaultdict(list)
    lines: dict[str, str] = {}
    for view in scene.train:
        for kind, line in _odd_about(view.camera).items():
            names[kind].append(view.name)
            lines.setdefault(kind, line)
    return [f"the camera of {some_of(names[kind])} has {line}" for kind, line in lines.items()]


def _odd_about(camera: Camera) -> dict[str, str]:
    """Texts about unusual intrinsics of ``camera``, by kind."""
    width, height = camera.width, camera.height
    field = math.degrees(2 * math.atan(width / (2 * camera.fx)))
    odd = {}
    if not MIN_FIELD_OF_VIEW < field < MAX_FIELD_OF_VIEW:
        odd["field"] = (
            f"a focal length of {camera.fx:.4g} px for a width of {width} px: check its unit"
        )
    if not 1 / MAX_PIXEL_RATIO < camera.fy / camera.fx < MAX_PIXEL_RATIO:
        odd["ratio"] = (
            f"focal lengths of {camera.fx:.4g} and {camera.fy:.4g} px, but pixels are square: "
            "check both"
        )
    least, most = CENTRAL
    if not (least < camera.cx / width < most and least < camera.cy / height < most):
        odd["center"] = (
            f"its principal point at ({camera.cx:.4g}, {camera.cy:.4g}) of {width}x{height} px, "
            "far from the middle: "
            "check its unit, unless the photographs were cropped"
        )
    return odd


def camera_distances(scene: Scene) -> tuple[Array, Array]:
    """The median position [3] of the training cameras, and the distance of each from it [V]."""
    centers = np.stack([view.camera.center for view in scene.train])  # [V, 3]
    middle = np.median(centers, axis=0)
    return middle, np.linalg.norm(centers - middle, axis=1)


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
