"""Features from outside COLMAP give the same model as its own, in the right coordinates."""

import itertools

import numpy as np
import pycolmap
import pytest
import torch
from kornia.feature import SIFTFeatureScaleSpace, laf_is_filled
from numpy.testing import assert_allclose, assert_array_equal

from gsbench.init import Sfm
from gsbench.init.colmap.database import (
    DatabaseTask,
    create_database,
    database_counts,
    unknown_camera_groups,
    write_features,
)
from gsbench.init.colmap.mapping import map_images
from gsbench.init.colmap.matches import extract_sift, match_sift, verify_pairs
from gsbench.init.networks import Features, extract_features
from gsbench.logs import no_progress

KNOWN = Sfm(camera="single", camera_model="PINHOLE", focal_length=300.0, threads=1)


def new_database(path, capture):
    names = sorted(capture.image_names)
    create_database(path, unknown_camera_groups(capture.images, names, KNOWN))
    return DatabaseTask(path, capture.images, names, list(itertools.combinations(names, 2)))


def rewritten(own, path, capture):
    """Write the features and matches of one database to another, as if they were foreign."""
    task = new_database(path, capture)
    with pycolmap.Database.open(own) as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        keypoints = {name: database.read_keypoints(ids[name])[:, :2] for name in task.names}
        matches = {(a, b): database.read_matches(ids[a], ids[b]) for a, b in task.pairs}
    write_features(path, keypoints, matches)
    verify_pairs(path, Sfm(), no_progress)


@pytest.fixture(scope="module")
def own_path(bare_photos, tmp_path_factory):
    """A database with COLMAP's own features and matches."""
    path = tmp_path_factory.mktemp("own") / "database.db"
    task = new_database(path, bare_photos)
    extract_sift(task, KNOWN, no_progress)
    match_sift(path, task.pairs, KNOWN, no_progress)
    return path


@pytest.mark.slow
def test_sift_through_the_external_path_gives_the_same_model(own_path, bare_photos, tmp_path):
    own, external = own_path, tmp_path / "external.db"
    rewritten(own, external, bare_photos)
    assert database_counts(external) == database_counts(own)

    first, second = (
        map_images(
            DatabaseTask(path, bare_photos.images, [], []), tmp_path / "map", Sfm(), no_progress
        ).model
        for path in (own, external)
    )
    assert first.num_points3D() == second.num_points3D() > 100
    for point_id, point in first.points3D.items():
        assert_array_equal(point.xyz, second.points3D[point_id].xyz)
    for image_id, image in first.images.items():
        other = second.images[image_id].cam_from_world().matrix()
        assert_array_equal(image.cam_from_world().matrix(), other)


def extract(path, max_image_size):
    """The features that kornia's SIFT finds."""
    sift = SIFTFeatureScaleSpace(2000, descriptor_backend="pyramid").eval()

    def found(image):
        frames, responses, descriptors = sift(image.mean(dim=1, keepdim=True))
        filled = laf_is_filled(frames)[0]
        return frames[0, filled, :, 2], descriptors[0, filled], responses[0, filled]

    settings = {"max_image_size": max_image_size, "max_keypoints": 2000}
    return extract_features(path, found, settings, torch.device("cpu"))


@pytest.mark.parametrize("max_image_size", [320, 213])
def test_keypoints_of_kornia_coincide_with_those_of_colmap(own_path, bare_photos, max_image_size):
    """Two implementations of SIFT find the same points; a wrong convention would shift all of them."""
    name = bare_photos.image_names[0]
    with pycolmap.Database.open(own_path) as database:
        colmap = database.read_keypoints(database.read_image_with_name(name).image_id)[:, :2]
    features = extract(bare_photos.images / name, max_image_size)
    assert features.network_size == (max_image_size, round(max_image_size * 0.75))
    ours = features.colmap_keypoints
    distances = np.linalg.norm(ours[:, None] - colmap[None], axis=2)  # [K, L]
    near = distances.min(axis=1) < 0.6
    offsets = (ours - colmap[distances.argmin(axis=1)])[near]
    assert near.sum() > 100
    assert np.abs(np.median(offsets, axis=0)).max() < 0.04  # px


def test_keypoints_are_scaled_separately_in_x_and_y():
    features = Features(
        np.array([[0, 0], [99, 49]], dtype=np.float32),
        *(np.zeros((2, 8), np.float32), np.ones(2, np.float32)),
        network_size=(100, 50),
        file_size=(400, 201),
    )
    assert_allclose(features.colmap_keypoints, [[2.0, 2.01], [398.0, 198.99]], rtol=1e-6)
