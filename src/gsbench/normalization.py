"""The frame in which a scene is trained.

It has the given coordinates, or they are moved to the origin and scaled to an ordinary size. 3DGS
has constants in world units: its near plane (0.2), the least distance between initial points, and
the volume threshold of arXiv 2508.05187, "in the units of the COLMAP model". COLMAP leaves its
models with the cameras around the origin, in a box with a diagonal of 10 units, so these constants
fit such models. A capture in kilometres would lie before the near plane, and at UTM coordinates
(5e5, 5.4e6) float32 has steps of half a metre.

So a model far from the origin, or of another order of size, is trained in COLMAP's frame. All
results are given back in its own coordinates. Ordinary models are not touched, so their results
keep every bit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsbench.parsing import Record

# units: the diagonal of the cameras' box after COLMAP's Reconstruction::Normalize
COLMAP_SIZE = 10.0
TRIMMED = 0.1  # the share of cameras left out at each end of each axis, as COLMAP does
MIN_TRIMMED = 6  # cameras; with fewer, none is left out (COLMAP: 11)
# A size within this factor of COLMAP's stays. At a third of it, the near plane is at 0.6 of
# COLMAP's units. None of 660,000 observations of two real captures (bonsai, herz_jesus_p25) is
# nearer than 1.
SIZE_FACTOR = 3.0
# Distances from the origin, in sizes, that stay. float32 then resolves 1e-6 of the size, far less
# than a pixel.
MAX_DISTANCE = 10.0
# of the distance from the origin; below it float64 cannot tell the cameras' places apart
MIN_SIZE = 1e-11


@dataclass(frozen=True)
class Normalization:
    """The map from a scene's own coordinates to those of its training: ``scale * (x - center)``."""

    __get_pydantic_core_schema__ = Record.__get_pydantic_core_schema__  # read within records

    center: tuple[float, float, float] = (0.0, 0.0, 0.0)
    scale: float = 1.0

    def __post_init__(self) -> None:
        if not np.isfinite([*self.center, self.scale]).all() or self.scale <= 0:
            raise ValueError(
                f"a normalisation needs a finite centre and a positive scale, got {self}"
            )

    @property
    def is_identity(self) -> bool:
        """Return whether the scene is trained in its own coordinates."""
        return self == IDENTITY

    @property
    def is_far(self) -> bool:
        """Return whether the scene's own coordinates need float64.

        They do if it lies far from the origin for its size.
        """
        return self.scale * max(map(abs, self.center)) > MAX_DISTANCE * COLMAP_SIZE

    def apply(self, points: ArrayLike) -> NDArray[np.float64]:
        """Map points [..., 3] of the scene's own coordinates to the training's (float64)."""
        mapped: NDArray[np.float64] = (
            np.asarray(points, dtype=np.float64) - self.center
        ) * self.scale
        return mapped

    def undo(self, points: ArrayLike) -> NDArray[np.float64]:
        """Map points [..., 3] of the training back to the scene's own coordinates (float64)."""
        own: NDArray[np.float64] = np.asarray(points, dtype=np.float64) / self.scale + self.center
        return own


IDENTITY = Normalization()


def find_normalization(centers: ArrayLike) -> Normalization:
    """Find the normalisation for a model by the ``centers`` [V, 3] of all its cameras.

    Splits and selections of images do not change it, and a few cameras far off hardly do.
    """
    places = np.asarray(centers, dtype=np.float64).reshape(-1, 3)
    ordered = np.sort(places, axis=0)  # [V, 3], each axis by itself
    # COLMAP leaves out none of up to ten cameras. Here a single camera far off must not decide.
    left_out = max(1, round(TRIMMED * len(ordered))) if len(ordered) >= MIN_TRIMMED else 0
    kept = ordered[left_out : len(ordered) - left_out]
    if not len(kept):
        return IDENTITY
    center, size = kept.mean(axis=0), float(np.linalg.norm(kept[-1] - kept[0]))
    distance = float(np.linalg.norm(center))
    if size <= MIN_SIZE * distance or size == 0.0:  # all cameras at one place: no size to go by
        return IDENTITY
    is_ordinary = COLMAP_SIZE / SIZE_FACTOR <= size <= COLMAP_SIZE * SIZE_FACTOR
    if is_ordinary and distance <= MAX_DISTANCE * size:
        return IDENTITY
    x, y, z = center.tolist()
    return Normalization((x, y, z), 1.0 if is_ordinary else COLMAP_SIZE / size)
