"""Distances of points to the courtyard's surfaces, and a digest of arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gsbench.scene.courtyard.kernels import nearest_surface
from gsbench.scene.courtyard.layout import build_layout


def surface_distance(
    points: NDArray[np.float64], seed: int = 0, limit: float = 1e3
) -> NDArray[np.float64]:
    """The distance in m from points [P, 3] to the nearest true surface, at most ``limit``; [P].

    It is exact outside all solids. Inside, it is the distance to the nearest surface of any
    primitive, including hidden surfaces.
    """
    layout = build_layout(seed)
    result = np.empty(len(points))
    _distances(layout, np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3), limit, result)
    return result


def fingerprint(values: NDArray[Any]) -> float:
    """One number that depends on ``values`` and their order, but hardly on their last digits."""
    flat = np.asarray(values, dtype=np.float64).ravel()
    return float(flat @ (1 + np.arange(len(flat)) % 7) / len(flat))


@njit
def _distances(layout: Any, points: Any, limit: float, result: Any) -> None:
    for p in range(len(points)):
        result[p] = nearest_surface(layout, points[p, 0], points[p, 1], points[p, 2], limit)
