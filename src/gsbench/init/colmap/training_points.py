"""Points that owe nothing to test photographs: what training views alone saw, or triangulated from them alone.

Cameras stay as they are. Everything here calls native code that can abort the process: run it isolated.
"""

from __future__ import annotations

import itertools
import shutil
from collections import defaultdict
from collections.abc import Collection
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from gsbench.errors import InputError
from gsbench.init.base import PointsFrom, TrainingPoints
from gsbench.init.colmap.database import create_database, image_ids, reference_groups, write_keypoints
from gsbench.init.colmap.reconstruct import MappingSettings, triangulate_known
from gsbench.scene.colmap import MIN_TRACK, rescaled_camera


def keep_training_points(model: pycolmap.Reconstruction, names: Collection[str], images: Path) -> TrainingPoints:
    """Leave in ``model`` what at least two of the images ``names`` see, with their observations and colours alone.

    Positions stay where they are; ``images`` is the folder of the photographs.
    """
    before, kept = model.num_points3D(), _ids(model, names)
    for point_id in sorted(model.points3D):
        point = model.points3D[point_id]
        seen = [(e.image_id, e.point2D_idx) for e in point.track.elements if e.image_id in kept]
        elements = [pycolmap.TrackElement(*place) for place in seen]
        left = pycolmap.Point3D(xyz=np.array(point.xyz), error=point.error, track=pycolmap.Track(elements))
        model.delete_point3D(point_id)  # with it goes all that was read from it
        if len({image_id for image_id, _ in seen}) < MIN_TRACK:
            continue
        model.add_point3D_with_id(point_id, left)
        for image_id, index in seen:
            model.images[image_id].set_point3D_for_point2D(index, point_id)
    model.extract_colors_for_all_images(images)
    return _record(model, before, "train")


def retriangulate(
    model: pycolmap.Reconstruction,
    names: Collection[str],
    database: Path,
    images: Path,
    scratch: Path,
    settings: MappingSettings,
) -> TrainingPoints:
    """Replace the points of ``model`` by those triangulated under its cameras from matches between images ``names``.

    ``database`` holds the matches, its keypoints are the 2D points of ``model``; it is left as it is.
    """
    before = model.num_points3D()
    own = database.with_name(f"training-{database.name}")
    shutil.copy(database, own)
    known = _known(model, names, own)
    _forget_other_matches(own, set(known.images))
    found = triangulate_known(known, own, images, scratch, settings)
    ids = {number: model.find_image_with_name(image.name).image_id for number, image in known.images.items()}
    for point_id in list(model.points3D):
        model.delete_point3D(point_id)
    for _, point in sorted(found.points3D.items()):
        elements = [pycolmap.TrackElement(ids[e.image_id], e.point2D_idx) for e in point.track.elements]
        model.add_point3D(point.xyz, pycolmap.Track(elements), point.color)
    model.update_point_3d_errors()
    return _record(model, before, "retriangulated")


def database_of_tracks(path: Path, model: pycolmap.Reconstruction, names: Collection[str]) -> None:
    """Write a database as if the observations of one point by the images ``names`` had been matched.

    Its keypoints are the 2D points of these images in ``model``.
    """
    numbers = create_database(path, reference_groups(model))
    points = {
        image.name: np.array([point.xy for point in image.points2D], dtype=np.float32).reshape(-1, 2)
        for image in model.images.values()
    }
    write_keypoints(path, {name: keypoints for name, keypoints in points.items() if name in set(names)})
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        for (first, second), indices in track_matches(model, names).items():
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            geometry.inlier_matches = indices
            pair = numbers[model.images[first].name], numbers[model.images[second].name]
            database.write_matches(*pair, indices)
            database.write_two_view_geometry(*pair, geometry)


def track_matches(model: pycolmap.Reconstruction, names: Collection[str]) -> dict[tuple[int, int], NDArray[np.uint32]]:
    """The 2D points [M, 2] of two images that see one point, by the pair of their ids, lower first."""
    kept = _ids(model, names)
    by_length: dict[int, list[list[tuple[int, int]]]] = defaultdict(list)
    for _, point in sorted(model.points3D.items()):
        track = {e.image_id: e.point2D_idx for e in point.track.elements if e.image_id in kept}
        if len(track) >= MIN_TRACK:
            by_length[len(track)].append(sorted(track.items()))
    rows = []
    for length, tracks in by_length.items():
        observations = np.array(tracks, dtype=np.int64)  # [P, T, 2]
        for one, other in itertools.combinations(range(length), 2):
            rows.append(np.concatenate([observations[:, one], observations[:, other]], axis=1))  # [P, 4]
    if not rows:
        return {}
    table = np.concatenate(rows)  # [M, 4]: image, 2D point, image, 2D point
    table = table[np.lexsort((table[:, 3], table[:, 1], table[:, 2], table[:, 0]))]
    starts = np.flatnonzero(np.any(np.diff(table[:, [0, 2]], axis=0), axis=1)) + 1
    return {
        (int(part[0, 0]), int(part[0, 2])): np.ascontiguousarray(part[:, [1, 3]], dtype=np.uint32)
        for part in np.split(table, starts)
    }


def _known(model: pycolmap.Reconstruction, names: Collection[str], database: Path) -> pycolmap.Reconstruction:
    """The images ``names`` of ``model`` with their cameras and poses and nothing else, under the database's ids."""
    known, wanted = pycolmap.Reconstruction(), set(names)
    with pycolmap.Database.open(database) as opened:
        stored = sorted(opened.read_all_images(), key=lambda image: image.image_id)
    for entry in stored:
        image = model.find_image_with_name(entry.name)
        if entry.name not in wanted or image is None or not image.has_pose:
            continue
        if not known.exists_camera(entry.camera_id):
            camera = model.cameras[image.camera_id]
            copy = rescaled_camera(camera, camera.width, camera.height, camera_id=entry.camera_id)
            known.add_camera_with_trivial_rig(copy)
        bare = pycolmap.Image(name=entry.name, camera_id=entry.camera_id, image_id=entry.image_id)
        known.add_image_with_trivial_frame(bare, image.cam_from_world())
    return known


def _forget_other_matches(path: Path, kept: set[int]) -> None:
    """Delete the matches of all pairs but those of the images ``kept``: tracks would be joined through the others."""
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        ids = sorted(image_ids(path).values())
        for first, second in itertools.combinations(ids, 2):
            if first in kept and second in kept:
                continue
            if database.exists_matches(first, second):
                database.delete_matches(first, second)
            if database.exists_two_view_geometry(first, second):
                database.delete_two_view_geometry(first, second)


def _ids(model: pycolmap.Reconstruction, names: Collection[str]) -> set[int]:
    wanted = set(names)
    return {image.image_id for image in model.images.values() if image.has_pose and image.name in wanted}


def _record(model: pycolmap.Reconstruction, before: int, choice: PointsFrom) -> TrainingPoints:
    left = model.num_points3D()
    if left == 0:
        raise InputError(
            f"init.points_from={choice}: no point is left that two training views see; take init.points_from=all, or "
            "hold out fewer views"
        )
    return TrainingPoints(choice, left, before, 1 - left / before if before else 0.0)
