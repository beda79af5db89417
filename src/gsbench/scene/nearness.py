"""Distances of views from those that a model was trained on: an error grows with that, whoever made the model."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gsbench.scene.camera import Camera

ANGLE, DISTANCE = "angle_to_nearest", "distance_to_nearest"
COUNTED = "counted"  # the share of a view's pixels that its mask does not ignore; where there are masks


Array = NDArray[np.float64]


def axis_angles(axes: Array, others: Array) -> Array:
    """Angles [V, W] in degrees between unit vectors [V, 3] and [W, 3]."""
    chords = np.linalg.norm(axes[:, None] - others[None], axis=-1)  # accurate near 0, where a cosine is not
    return 2 * np.degrees(np.arcsin(np.clip(chords / 2, 0.0, 1.0)))


def nearness(cameras: Sequence[Camera], training: Sequence[Camera], extent: float) -> list[dict[str, float]]:
    """Measure how far each of ``cameras`` is from the training cameras: the nearest in angle and the nearest in place.

    ``angle_to_nearest`` is the least angle between its viewing direction and that of a training camera, in degrees;
    ``distance_to_nearest`` the least distance between their centres, in scene extents (not given where that is 0).
    """
    if not cameras or not training:
        return [{} for _ in cameras]
    axes, others = (np.array([camera.rotation[2] for camera in group]) for group in (cameras, training))
    places, theirs = (np.array([camera.center for camera in group]) for group in (cameras, training))
    angles = axis_angles(axes, others).min(axis=1)  # [V]
    distances = np.linalg.norm(places[:, None] - theirs[None], axis=-1).min(axis=1)  # [V]
    found = []
    for angle, distance in zip(angles, distances, strict=True):
        entry = {ANGLE: float(angle)}
        if extent > 0:
            entry[DISTANCE] = float(distance) / extent
        found.append(entry)
    return found
