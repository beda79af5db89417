"""The frame of a training: models as COLMAP leaves them keep theirs, all others get COLMAP's."""

import numpy as np
import pycolmap
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from gsbench.normalization import COLMAP_SIZE, IDENTITY, Normalization, find_normalization

SEEDS = st.integers(0, 10**6)


def cameras(seed, count):
    """Centres [V, 3] on a ring, on a plane, or in a box, of size about 1."""
    rng = np.random.default_rng(seed)
    if seed % 3 == 0:
        angles = np.sort(rng.uniform(0, 2 * np.pi, count))
        return np.stack([np.cos(angles), np.sin(angles), 0.1 * rng.normal(size=count)], axis=1)
    return rng.uniform(-1, 1, (count, 3)) * ([1, 1, 0.05] if seed % 3 == 1 else [1, 1, 1])


def as_colmap_leaves(centers):
    """The centres after COLMAP's own normalisation of a model."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera.create_from_model_name(1, "PINHOLE", 50.0, 40, 30)
    )
    for index, center in enumerate(centers):
        image = pycolmap.Image(name=f"{index}.png", camera_id=1, image_id=index + 1)
        model.add_image_with_trivial_frame(
            image, pycolmap.Rigid3d(np.column_stack([np.eye(3), -center]))
        )
    model.normalize()
    return np.array([image.projection_center() for _, image in sorted(model.images.items())])


@given(SEEDS, st.integers(8, 200))
def test_models_that_colmap_normalized_keep_their_coordinates(seed, count):
    assert find_normalization(as_colmap_leaves(cameras(seed, count))) is IDENTITY


@pytest.mark.parametrize("count", [3, 4, 5, 11, 12, 13, 14])
def test_other_units_get_the_size_that_colmap_gives(count):
    for seed in range(6):
        normalization = find_normalization(100 * as_colmap_leaves(cameras(seed, count)))
        assert normalization.scale == pytest.approx(0.01, rel=1e-6), seed


@pytest.mark.parametrize("count", [5, 6])
def test_one_camera_far_away_decides_the_size_only_among_fewer_than_six(count):
    centers = 100 * cameras(1, count)
    centers[0] *= 1e4
    size = COLMAP_SIZE / find_normalization(centers).scale
    assert (size < 300) == (count >= 6)


@given(SEEDS, st.integers(3, 60), st.floats(-4, 4), st.floats(0, 7))
def test_normalized_cameras_do_not_depend_on_a_similarity(seed, count, log_scale, log_shift):
    centers = cameras(seed, count)
    normalization = find_normalization(centers)  # a size of about 1 is not ordinary
    assert not normalization.is_identity
    moved = 10**log_scale * centers + 10**log_shift * np.array([0.6, -0.7, 0.4])
    again = find_normalization(moved)
    own, other = normalization.apply(centers), again.apply(moved)
    if again.scale != 1:
        # float64 at 1e7 resolves 2e-9, and the size may be 1e-4
        assert_allclose(other, own, atol=2e-3)
        assert COLMAP_SIZE / 4 < np.ptp(other, axis=0).max() < 6 * COLMAP_SIZE
    assert_allclose(again.undo(other), moved, rtol=1e-12, atol=1e-12 * np.abs(moved).max())


@given(SEEDS, st.integers(8, 40), st.floats(3, 12))
def test_one_camera_far_away_hardly_changes_the_scale(seed, count, log_distance):
    centers = as_colmap_leaves(cameras(seed, count))
    before = find_normalization(centers)
    centers[seed % count] += 10**log_distance * np.array([0.2, -0.9, 0.4])
    after = find_normalization(centers)
    assert 0.2 < after.scale / before.scale < 5


def test_a_rotation_changes_the_scale_by_less_than_two():
    centers = cameras(3, 30)
    scales = [
        find_normalization(Rotation.random(random_state=k).apply(centers)).scale for k in range(20)
    ]
    assert max(scales) / min(scales) < 2


@pytest.mark.parametrize("centers", [np.zeros((0, 3)), np.ones((5, 3)), np.full((3, 3), 5.4e6)])
def test_cameras_at_one_place_are_not_normalized(centers):
    assert find_normalization(centers) is IDENTITY


@pytest.mark.parametrize(
    "center, scale", [((0, 0, 0), 0), ((0, 0, 0), -1), ((0, float("nan"), 0), 1)]
)
def test_a_normalization_needs_finite_numbers_and_a_positive_scale(center, scale):
    with pytest.raises(ValueError, match="positive scale"):
        Normalization(center, scale)


def box(size, center=0.0):
    """Two cameras at the ends of a diagonal of this length along x, around ``center``."""
    return np.array([[center - size / 2, 0, 0], [center + size / 2, 0, 0]])


@pytest.mark.parametrize(
    "size, center, scale, moved",
    [
        (30.0, 0.0, 1.0, False),  # three times COLMAP's size
        (30.01, 0.0, 10 / 30.01, True),
        (10 / 3, 0.0, 1.0, False),
        (3.33, 0.0, 10 / 3.33, True),
        (10.0, 100.0, 1.0, False),  # ten sizes from the origin
        (10.0, 100.01, 1.0, True),
        (40.0, 4e6, 0.25, True),
        (1e-4, 1e5, 1e5, True),
        (5e-7, 1e5, 1.0, False),  # below what float64 can tell apart
    ],
)
def test_a_model_is_normalized_beyond_the_limits(size, center, scale, moved):
    found = find_normalization(box(size, center))
    assert found.is_identity != moved
    assert found.scale == pytest.approx(scale, rel=1e-4)
    assert found.center == pytest.approx((center if moved else 0.0, 0.0, 0.0))
    if moved:
        assert found.apply([center, 0, 2]).tolist() == pytest.approx([0, 0, 2 * scale], 1e-6, 1e-3)
        assert found.undo([0, 0, 2]).tolist() == pytest.approx([center, 0, 2 / scale])


def test_a_scene_is_far_beyond_ten_sizes_after_scaling():
    assert not Normalization((0.0, -100.0, 0.0), 1.0).is_far
    assert Normalization((0.0, -100.1, 0.0), 1.0).is_far
    assert not Normalization((0.0, -1000.0, 0.0), 0.1).is_far
    assert Normalization((60.0, 0.0, 0.0), 2.0).is_far
