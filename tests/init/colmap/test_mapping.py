"""Captures that COLMAP's defaults refuse: exact matches of a forward-facing rig whose cameras are known to the test."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from PIL import Image

from gsbench.errors import InputError
from gsbench.init import Sfm
from gsbench.init.colmap.alignment import align_poses
from gsbench.init.colmap.database import (
    assume_focal_lengths,
    cameras_without_prior,
    create_database,
    guessed_groups,
    verify_pairs,
    write_keypoints,
    write_matches,
)
from gsbench.init.colmap.mapping import Mapped, map_images
from gsbench.init.colmap.reconstruct import poses_by_name, verification_options
from gsbench.logs import no_progress

WIDTH, HEIGHT, FOCAL = 640, 480, 520.0  # px; COLMAP's guess without EXIF is 1.2 x 640 = 768
VERIFICATION = verification_options(Sfm())


def small_baseline(folder: Path, spread: float = 0.2, turn: float = 0.0) -> tuple[Path, dict[str, np.ndarray]]:
    """A database of exact matches between nine cameras side by side, looking ahead; and the true camera centres.

    ``spread`` is half the width of the rig, for points 3 to 9 away; at 0.2 no two cameras see one under 11 degrees.
    """
    rng = np.random.default_rng(0)
    points = rng.uniform((-3, -2.2, 3), (3, 2.2, 9), (900, 3))
    names, centers, keypoints, seen = [], {}, {}, {}
    (folder / "images").mkdir(parents=True)
    for index in range(9):
        name = f"{index}.png"
        Image.new("RGB", (WIDTH, HEIGHT)).save(folder / "images" / name)
        center = np.array([(index % 3 - 1) * spread, (index // 3 - 1) * spread, 0.05 * (index % 2)])
        local = points - center
        pixels = FOCAL * local[:, :2] / local[:, 2:] + (WIDTH / 2, HEIGHT / 2) + rng.normal(0, 0.3, (900, 2))
        inside = ((pixels > 0) & (pixels < (WIDTH, HEIGHT))).all(axis=1)
        names.append(name)
        centers[name], seen[name], keypoints[name] = center, np.flatnonzero(inside), pixels[inside].astype(np.float32)
    database = folder / "database.db"
    create_database(database, guessed_groups(folder / "images", names, "single", "SIMPLE_RADIAL", None))
    write_keypoints(database, keypoints)
    matches = {}
    for i, first in enumerate(names):
        for second in names[i + 1 :]:
            _, a, b = np.intersect1d(seen[first], seen[second], return_indices=True)
            matches[first, second] = np.stack([a, b], axis=1).astype(np.uint32)
    write_matches(database, matches)
    verify_pairs(database, sorted(matches), VERIFICATION, no_progress)
    return database, centers


def mapped(database: Path, mapper: Any) -> Mapped:
    images = database.parent / "images"
    return map_images(database, images, database.parent / "out", Sfm(mapper=mapper), no_progress)


@pytest.mark.slow
def test_a_small_baseline_without_a_focal_length_is_placed_by_another_way(tmp_path: Path) -> None:
    database, truth = small_baseline(tmp_path)
    with pytest.raises(InputError, match="found no pair of images to start from"):
        mapped(database, "incremental")
    result = mapped(database, "auto")
    assert result.model.num_reg_images() == 9
    assert result.tried[0] == ("incremental", 0)
    assert result.way != "incremental"
    (warning,) = result.warnings
    assert result.way in warning
    ours = poses_by_name(result.model)
    names = sorted(truth)
    similarity = align_poses(
        np.array([ours[name][0] for name in names]),
        np.array([ours[name][1] for name in names]),
        np.array([truth[name] for name in names]),
        np.stack([np.eye(3)] * 9),
    )
    placed = similarity(np.array([ours[name][0] for name in names]))
    assert np.abs(placed - np.array([truth[name] for name in names])).max() < 0.03  # of a rig 0.4 wide
    (camera,) = result.model.cameras.values()
    assert camera.mean_focal_length() == pytest.approx(FOCAL, rel=0.2)  # which so small a baseline fixes weakly


def test_the_global_mapper_alone(tmp_path: Path) -> None:
    database, _ = small_baseline(tmp_path)
    result = mapped(database, "global")
    assert (result.way, result.model.num_reg_images(), result.warnings) == ("global", 9, ())


def test_where_the_defaults_do_nothing_else_is_tried(tmp_path: Path) -> None:
    database, _ = small_baseline(tmp_path, spread=1.2)
    result = mapped(database, "auto")
    assert result.tried == (("incremental", 9),)
    assert result.warnings == ()


def test_an_assumed_focal_length_is_known_and_verified_anew(tmp_path: Path) -> None:
    database, _ = small_baseline(tmp_path)
    assert cameras_without_prior(database)
    pairs = assume_focal_lengths(database, 0.8)
    assert not cameras_without_prior(database)
    assert len(pairs) == 36
    with pycolmap.Database.open(database) as opened:
        (camera,) = opened.read_all_cameras()
        assert camera.mean_focal_length() == pytest.approx(0.8 * WIDTH)
        assert opened.num_verified_image_pairs() == 0
    verify_pairs(database, pairs, VERIFICATION, no_progress)
    with pycolmap.Database.open(database) as opened:
        assert opened.num_verified_image_pairs() == 36


@pytest.mark.parametrize("mapper", [pytest.param("auto", marks=pytest.mark.slow), "global"])
def test_copies_of_one_view_are_no_scene(tmp_path: Path, mapper: Any) -> None:
    """Without parallax every way must be refused, not believed."""
    database, _ = small_baseline(tmp_path, spread=0.0)
    with pytest.raises(InputError, match="structure from motion"):
        mapped(database, mapper)
