"""The similarity between camera sets, against scikit-image and known transformations."""

import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation
from skimage.transform import SimilarityTransform

from gsbench.init.colmap.models import align_poses, compare_poses, fit_similarity

TRUE_SCALE = 2.5
TRUE_ROTATION = Rotation.from_rotvec([0.3, -1.1, 2.0]).as_matrix()
TRUE_TRANSLATION = np.array([4.0, -1.0, 0.5])


def poses(count, seed=0):
    """Random cameras, and the same cameras after the true similarity."""
    rng = np.random.default_rng(seed)
    centers = rng.normal(size=(count, 3))
    rotations = Rotation.random(count, rng=rng).as_matrix()
    moved = TRUE_SCALE * centers @ TRUE_ROTATION.T + TRUE_TRANSLATION
    return centers, rotations, moved, rotations @ TRUE_ROTATION.T


def test_fit_agrees_with_two_libraries_on_noisy_points():
    rng = np.random.default_rng(3)
    source, _, target, _ = poses(20)
    target = target + 0.3 * rng.normal(size=target.shape)
    ours = fit_similarity(source, target)
    theirs = SimilarityTransform.from_estimate(source, target)
    assert_allclose(ours * source, theirs(source), atol=1e-9)
    assert_allclose(ours.matrix(), pycolmap.estimate_sim3d(source, target).matrix(), atol=1e-9)


def test_reflected_points_give_a_rotation():
    source, _, target, _ = poses(10)
    turn = fit_similarity(source, target * [1, 1, -1]).rotation.matrix()
    assert np.linalg.det(turn) == pytest.approx(1.0)


def test_three_cameras_give_a_similarity_and_two_do_not():
    assert align_poses(*poses(3)).scale == pytest.approx(TRUE_SCALE, rel=1e-9)
    assert align_poses(*poses(2)) is None


@pytest.mark.parametrize("away", [0.0, 1000.0])
def test_wrong_cameras_do_not_change_the_alignment(away):
    """The origin may be far away, as in captures with satellite positions."""
    centers, rotations, moved, moved_rotations = poses(30)
    centers, moved = centers + away, moved + away * TRUE_SCALE * TRUE_ROTATION.sum(axis=1)
    wrong = moved.copy()
    wrong[:10] += np.random.default_rng(1).normal(size=(10, 3)) * 20
    similarity = align_poses(centers, rotations, wrong, moved_rotations)
    assert similarity.scale == pytest.approx(TRUE_SCALE, rel=1e-9)
    assert_allclose(similarity * centers, moved, atol=1e-8)
    # wrong cameras do move plain least squares
    assert abs(fit_similarity(centers, wrong).scale - TRUE_SCALE) > 0.5
    again = align_poses(centers, rotations, wrong, moved_rotations)
    assert_array_equal(again.matrix(), similarity.matrix())


def test_cameras_on_a_line_are_aligned_by_their_orientations():
    _, rotations, _, moved_rotations = poses(6)
    centers = np.linspace(-1, 2, 6)[:, None] * [1.0, 2.0, 3.0]
    moved = TRUE_SCALE * centers @ TRUE_ROTATION.T + TRUE_TRANSLATION
    similarity = align_poses(centers, rotations, moved, moved_rotations)
    assert_allclose(similarity.rotation.matrix(), TRUE_ROTATION, atol=1e-9)
    assert_allclose(similarity * centers, moved, atol=1e-9)


@pytest.mark.parametrize("centers", [np.zeros((2, 3)), np.ones((5, 3))])
def test_too_few_or_coinciding_cameras_are_not_aligned(centers):
    rotations = np.tile(np.eye(3), (len(centers), 1, 1))
    assert align_poses(centers, rotations, centers, rotations) is None


@pytest.mark.parametrize("degrees", [0.0, 1e-6, 0.05, 30.0, 179.9, 180.0])
def test_rotation_errors_are_the_angles_by_which_cameras_are_turned(degrees):
    turn = Rotation.from_rotvec(np.radians(degrees) * np.array([0.6, 0.0, 0.8])).as_matrix()
    centers, rotations, moved, turned = poses(4)
    found = compare_poses(
        (centers, rotations, moved, turn @ turned), align_poses(*poses(4)), 1.0, exact=True
    )
    assert found.rotation_mean_deg == pytest.approx(degrees, rel=1e-6, abs=1e-6)
    assert found.rotation_max_deg == pytest.approx(degrees, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e4])
def test_collinearity_does_not_depend_on_the_scale(scale):
    """Cameras on a line are aligned by orientations, others by their centres alone."""
    centers, _, moved, _ = poses(9, seed=4)
    others = Rotation.random(9, rng=np.random.default_rng(5)).as_matrix()
    similarity = align_poses(scale * centers, others, moved, others)
    assert_allclose(similarity * (scale * centers), moved, atol=1e-6)
    flat = centers * [1.0, 1.0, 0.0]
    flat_moved = TRUE_SCALE * flat @ TRUE_ROTATION.T
    assert_allclose(
        align_poses(scale * flat, others, flat_moved, others) * (scale * flat),
        flat_moved,
        atol=1e-6,
    )
    bent = np.linspace(-1, 2, 9)[:, None] * [1.0, 2.0, 3.0] + 1e-3 * centers
    similarity = align_poses(scale * bent, others, bent, others)
    assert_allclose(similarity.rotation.matrix(), np.eye(3), atol=1e-9)
    assert similarity.scale == pytest.approx(1 / scale)


@pytest.mark.parametrize("count", [3, 40])
def test_without_wrong_cameras_all_are_fitted_by_least_squares(count):
    centers, rotations, moved, moved_rotations = poses(count, seed=2)
    moved = moved + np.random.default_rng(6).uniform(-0.01, 0.01, moved.shape)
    similarity = align_poses(centers, rotations, moved, moved_rotations)
    assert_allclose(similarity.matrix(), fit_similarity(centers, moved).matrix(), atol=1e-9)
