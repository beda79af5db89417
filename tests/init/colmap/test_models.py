"""Triangulation under given cameras, and the poses of two models, on exact matches."""

import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from scipy.spatial.transform import Rotation

from gsbench.init import Sfm
from gsbench.init.base import TrainingPoints
from gsbench.init.colmap import mapping, matches, models
from gsbench.init.colmap import pairs as pairing
from gsbench.init.colmap.database import DatabaseTask, create_database, write_features
from gsbench.init.colmap.matches import verify_pairs
from gsbench.logs import no_progress
from tests.helpers import refusal
from tests.init.models import add_point, camera_at, model_with

WIDTH, HEIGHT, FOCAL = 320, 240, 260.0  # px
NAMES = [f"{letter}.png" for letter in "abcd"]
POINTS = np.random.default_rng(0).uniform((-2, -1.5, 4), (2, 1.5, 7), (120, 3))


def camera():
    return pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", FOCAL, WIDTH, HEIGHT)


def poses():
    """Four cameras on an arc, each turned towards the points."""
    made = {}
    for index, name in enumerate(NAMES):
        turn = Rotation.from_euler("yx", [8.0 * (index - 1.5), 3.0 * index], degrees=True)
        made[name] = camera_at([0.8 * (index - 1.5), 0.2 * index, 0.1], turn.as_matrix())
    return made


def model_of(poses):
    """A model without points whose image ids differ from the database's."""
    return model_with(dict(reversed(poses.items())), camera=camera())


@pytest.fixture(scope="module")
def database(tmp_path_factory):
    """A database of the points in all cameras, with verified matches."""
    folder = tmp_path_factory.mktemp("exact")
    (folder / "images").mkdir()
    keypoints = {}
    for name, pose in poses().items():
        Image.new("RGB", (WIDTH, HEIGHT)).save(folder / "images" / name)
        local = POINTS @ pose.rotation.matrix().T + pose.translation
        pixels = FOCAL * local[:, :2] / local[:, 2:] + (WIDTH / 2, HEIGHT / 2)
        keypoints[name] = pixels.astype(np.float32)
    path = folder / "database.db"
    create_database(path, [(camera(), NAMES)])
    same = np.stack([np.arange(len(POINTS))] * 2, axis=1).astype(np.uint32)
    pairs = pairing.select_pairs(NAMES, Sfm())
    write_features(path, keypoints, dict.fromkeys(pairs, same))
    verify_pairs(path, Sfm(), no_progress)
    return DatabaseTask(path, folder / "images", NAMES, pairs)


def test_points_are_triangulated_from_the_named_images_and_cameras_do_not_change(
    database, tmp_path
):
    said, tell = [], lambda *at: said.append(at)
    task = database._replace(names=NAMES[:3])
    model = mapping.triangulate(task, tmp_path, model_of(poses()), Sfm(), tell)
    assert said == [("triangulate", 0, 1), ("triangulate", 1, 1)]
    placed = {image.name: image for image in model.images.values()}
    assert sorted(placed) == NAMES  # an image without points has its camera, too
    for name, pose in poses().items():
        assert placed[name].cam_from_world().matrix().tobytes() == pose.matrix().tobytes()
    assert model.num_points3D() > 100
    for point in model.points3D.values():
        seen = {model.images[element.image_id].name for element in point.track.elements}
        assert len(seen) >= 2
        assert seen <= set(NAMES[:3])
        index = next(element.point2D_idx for element in point.track.elements)
        assert_allclose(point.xyz, POINTS[index], atol=1e-3)


def test_matches_that_contradict_the_cameras_are_refused(database, tmp_path):
    reference = model_of(dict(zip(NAMES, reversed(poses().values()), strict=True)))
    with refusal("no point could be triangulated under the reference cameras"):
        mapping.triangulate(database, tmp_path, reference, Sfm(), no_progress)


def test_points_of_training_views_keep_place_and_observations_and_get_those_views_colours(tmp_path):
    model = model_with(poses(), 3, camera())
    for shade, name in zip((10, 20, 60, 200), NAMES, strict=True):
        Image.new("RGB", (WIDTH, HEIGHT), (shade, 0, 255 - shade)).save(tmp_path / name)
        for point in model.find_image_with_name(name).points2D:
            point.xy = np.array([WIDTH / 2, HEIGHT / 2])
    for index, seen in enumerate(((1, 2, 4), (3, 4), (1, 3))):
        add_point(model, POINTS[index], seen_by=dict.fromkeys(seen, index))
    found = models.keep_training_points(model, NAMES[:3], tmp_path)
    assert found == TrainingPoints("train", 2, 3, pytest.approx(1 / 3))
    assert sorted(model.points3D) == [1, 3]
    for number, seen, shade in ((1, [1, 2], 15), (3, [1, 3], 35)):
        point = model.points3D[number]
        assert_array_equal(point.xyz, POINTS[number - 1])
        assert [element.image_id for element in point.track.elements] == seen
        assert point.color.tolist() == [shade, 0, 255 - shade]
        for image_id in seen:
            assert model.images[image_id].points2D[number - 1].point3D_id == number


def test_settings_reach_colmaps_verification():
    made = matches.verification_options(Sfm(seed=7, min_inliers=11, min_inlier_ratio=0.31))
    assert made.ransac.random_seed == 7
    assert (made.min_num_inliers, made.min_inlier_ratio) == (11, 0.31)
