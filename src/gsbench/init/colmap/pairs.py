"""Pairs of images to be matched. All functions return index pairs (i, j), i < j, sorted."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Pair = tuple[int, int]

Pairing = Literal["exhaustive", "auto", "sequential", "spatial"]
EARTH_RADIUS_M = 6_371_000.0
_GPS_IFD = 0x8825  # EXIF tags
_GPS_LATITUDE_REF, _GPS_LATITUDE, _GPS_LONGITUDE_REF, _GPS_LONGITUDE, _GPS_ALTITUDE = 1, 2, 3, 4, 6


def exhaustive_pairs(count: int) -> list[Pair]:
    """List every pair of ``count`` images.

    Examples:
        >>> exhaustive_pairs(3)
        [(0, 1), (0, 2), (1, 2)]
    """
    return [(i, j) for i in range(count) for j in range(i + 1, count)]


def sequential_pairs(count: int, overlap: int) -> list[Pair]:
    """Pair each image with the next ``overlap`` ones, and those 1, 2, 4, … 2^(overlap - 1) further on, as COLMAP does.

    Examples:
        >>> sequential_pairs(6, 3)
        [(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (1, 3), (1, 4), (1, 5), (2, 3), (2, 4), (2, 5), (3, 4), (3, 5), (4, 5)]
    """
    steps = {*range(1, overlap + 1), *(2**power for power in range(overlap))}
    return sorted((i, i + step) for i in range(count) for step in steps if i + step < count)


def spatial_pairs(positions: NDArray[np.float64], neighbors: int) -> list[Pair]:
    """Pair each image with its ``neighbors`` nearest ones; ``positions`` [N, 3] in any unit of length."""
    pairs: set[Pair] = set()
    for i, position in enumerate(positions):
        distances = np.linalg.norm(positions - position, axis=1)  # [N]
        distances[i] = np.inf
        nearest = np.argsort(distances, kind="stable")[: min(neighbors, len(positions) - 1)]
        pairs.update((min(i, int(j)), max(i, int(j))) for j in nearest)
    return sorted(pairs)


def gps_positions(paths: list[Path]) -> NDArray[np.float64] | None:
    """Positions [N, 3] in metres (east, north, up) from the images' EXIF GPS fields, or None where one has none."""
    from PIL import Image

    geodetic = []
    for path in paths:
        try:
            with Image.open(path) as image:
                gps = image.getexif().get_ifd(_GPS_IFD)
            latitude = _degrees(gps[_GPS_LATITUDE], gps[_GPS_LATITUDE_REF] == "S")
            longitude = _degrees(gps[_GPS_LONGITUDE], gps[_GPS_LONGITUDE_REF] == "W")
            geodetic.append((latitude, longitude, float(gps.get(_GPS_ALTITUDE, 0.0))))
        except Exception:  # noqa: BLE001 - Pillow raises many kinds on damaged fields, as if there were none
            return None
    if not np.isfinite(geodetic).all():
        return None
    latitudes, longitudes, altitudes = np.array(geodetic).reshape(-1, 3).T
    radians = np.radians
    east = EARTH_RADIUS_M * radians(longitudes - longitudes.mean()) * np.cos(radians(latitudes.mean()))
    north = EARTH_RADIUS_M * radians(latitudes - latitudes.mean())
    return np.stack([east, north, altitudes], axis=1)


def _degrees(parts: tuple[float, float, float], negative: bool) -> float:
    degrees, minutes, seconds = (float(part) for part in parts)
    value = degrees + minutes / 60 + seconds / 3600
    return -value if negative else value
