"""Which images are paired."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gsbench.init.colmap.pairs import exhaustive_pairs, gps_positions, sequential_pairs, spatial_pairs


def test_exhaustive_is_every_pair_once():
    assert exhaustive_pairs(5) == list(itertools.combinations(range(5), 2))


def test_sequential_has_near_neighbours_and_powers_of_two():
    pairs = sequential_pairs(40, 4)
    assert sorted({j - i for i, j in pairs}) == [1, 2, 3, 4, 8]
    assert len(pairs) == len(set(pairs)) == sum(40 - step for step in (1, 2, 3, 4, 8))


def test_spatial_is_the_nearest_by_brute_force():
    positions = np.random.default_rng(0).normal(size=(12, 3))
    distance = np.linalg.norm(positions[:, None] - positions[None], axis=2)
    expected = set()
    for i in range(12):
        others = sorted((distance[i, j], j) for j in range(12) if j != i)
        expected |= {(min(i, j), max(i, j)) for _, j in others[:3]}
    assert spatial_pairs(positions, 3) == sorted(expected)
    assert spatial_pairs(positions, 99) == exhaustive_pairs(12)


def _photo(path: Path, latitude: float, longitude: float) -> Path:
    exif = Image.Exif()
    for tag, value, names in ((1, latitude, "NS"), (3, longitude, "EW")):
        degrees, rest = divmod(abs(value), 1)
        minutes, seconds = divmod(rest * 60, 1)
        exif.get_ifd(0x8825)[tag] = names[value < 0]
        exif.get_ifd(0x8825)[tag + 1] = (degrees, minutes, seconds * 60)
    Image.new("RGB", (8, 8)).save(path, exif=exif)
    return path


def test_gps_positions_are_metres(tmp_path: Path):
    # a degree of latitude is 111.19 km on the sphere of 6371 km; of longitude, cos(latitude) times that
    paths = [
        _photo(tmp_path / "a.jpg", -33.0, -70.0),
        _photo(tmp_path / "b.jpg", -33.001, -70.0),
        _photo(tmp_path / "c.jpg", -33.0, -70.001),
    ]
    positions = gps_positions(paths)
    assert positions is not None
    assert np.linalg.norm(positions[0] - positions[1]) == pytest.approx(111.19, abs=0.05)
    assert np.linalg.norm(positions[0] - positions[2]) == pytest.approx(111.19 * np.cos(np.radians(33)), abs=0.05)
    assert positions[1, 1] < positions[0, 1]  # further south
    assert positions[2, 0] < positions[0, 0]  # further west


def test_gps_is_all_or_nothing(tmp_path: Path):
    Image.new("RGB", (8, 8)).save(tmp_path / "plain.jpg")
    assert gps_positions([_photo(tmp_path / "a.jpg", 1.0, 2.0), tmp_path / "plain.jpg"]) is None
