"""Contiguous parts of cameras, and how far a view is from the training views."""

from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsbench.scene.courtyard.render import ring_camera
from gsbench.scene.hold_out import arrange_cameras, sector_range
from gsbench.scene.types import ANGLE, DISTANCE, Camera, nearest_training_cameras
from tests.scene import cameras

looking = partial(cameras.looking, size=(40, 30), focal=50.0)


def ring(degrees, radius=3.0):
    angles = np.radians(degrees)
    return [
        looking(np.array([radius * np.cos(a), radius * np.sin(a), 1.5]), np.zeros(3))
        for a in angles
    ]


def turned(camera, rotation, shift, scale):
    """The camera after the world was scaled, turned and shifted."""
    world = camera.rotation @ rotation.T
    center = scale * rotation @ camera.center + shift
    return Camera(40, 30, 50.0, 50.0, 20.0, 15.0, world, -world @ center)


def some_rotation(seed):
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q @ np.diag(np.sign(np.diag(r)))
    return q * np.sign(np.linalg.det(q))


def is_cyclic_run(found, order):
    """Whether ``found`` is one contiguous run of the cyclic ``order``."""
    inside = [index in found for index in order]
    return sum(a != b for a, b in zip(inside, inside[1:] + inside[:1], strict=True)) <= 2


@given(st.integers(0, 99), st.integers(2, 6), st.booleans())
def test_a_ring_is_cut_by_azimuth_in_any_order_and_coordinates(seed, sectors, far):
    degrees = list(np.random.default_rng(seed).permutation(np.arange(24) * 15.0))
    rotation, shift = some_rotation(seed), np.array([5.0, -3.0, 2.0]) * (100 if far else 1)
    order, why = arrange_cameras([turned(camera, rotation, shift, 0.3) for camera in ring(degrees)])
    assert "surround" in why
    assert order[0] == 0, "a closed ring begins at the first camera"
    around = [int(index) for index in np.argsort(degrees)]
    parts = [{order[place] for place in sector_range(24, part, sectors)} for part in range(sectors)]
    assert sorted(index for part in parts for index in part) == list(range(24))
    assert all(is_cyclic_run(part, around) for part in parts)


def test_azimuths_do_not_depend_on_heights_and_are_rounded():
    angles = np.radians([*range(0, 360, 20), -3e-7])
    eyes = [
        np.array([3 * np.cos(a), 3 * np.sin(a), 1.0 + (k % 2) * (k < 18)])
        for k, a in enumerate(angles)
    ]
    order, why = arrange_cameras([looking(eye, np.zeros(3)) for eye in eyes])
    assert order == [0, 18, *range(1, 18)]
    assert "gaps up to 20 degrees" in why


def test_an_open_ring_starts_after_its_gap():
    degrees = [100.0, 60.0, 20.0, 140.0, 180.0, 220.0, 260.0]  # nothing from 260 to 380
    assert [degrees[k] for k in arrange_cameras(ring(degrees))[0]] == sorted(degrees)


def test_cameras_on_one_side_are_cut_by_planes_in_order():
    order, why = arrange_cameras(ring([0.0, 20.0, 40.0, 60.0, 80.0, 100.0]))
    assert "one side" in why
    assert order == [0, 1, 2, 3, 4, 5]


def test_parallel_and_outward_looking_cameras_are_cut_by_planes():
    places = [np.array([x, 0.0, 0.0]) for x in (0.0, 3.0, 1.0, 2.0)]
    row = [looking(place, place + np.array([0.0, 5.0, 0.0])) for place in places]
    order, why = arrange_cameras(row)
    assert "one direction" in why
    assert order == [0, 2, 3, 1]
    for side in (1, -1):  # the first camera is at the mean, so the second one fixes the sign
        places = [np.array([side * x, 0.0, 0.0]) for x in (0.0, 1.0, -1.0, 2.0, -2.0)]
        row = [looking(place, place + np.array([0.0, 5.0, 0.0])) for place in places]
        assert arrange_cameras(row)[0] == [3, 1, 0, 2, 4]
    outward = [
        looking(camera.center, 2 * camera.center - [0, 0, 1.5])
        for camera in ring([0.0, 90.0, 180.0, 270.0, 45.0])
    ]
    assert "do not look at one place" in arrange_cameras(outward)[1]


def test_nine_of_ten_cameras_must_look_towards_the_centre():
    """The cameras that look away have the centre exactly behind them."""
    for away, surrounds in ((1, True), (2, False)):
        around = ring([36.0 * k for k in range(10)])
        for k in range(away):
            around[k] = looking(around[k].center, 2 * around[k].center)
        assert ("surround" in arrange_cameras(around)[1]) == surrounds


def test_a_first_camera_straight_above_the_centre_is_accepted():
    """The poses of the cameras above are exact, so they have no azimuth to the last digit."""
    around = np.array([[3.0, 0, 0], [0, 3, 0], [-3, 0, 0], [0, -3, 0]])
    level = [looking(place, np.zeros(3)) for place in around]
    above = np.array([[[1.0, 0, 0], [0, -1, 0], [0, 0, -1]], [[-1.0, 0, 0], [0, 1, 0], [0, 0, -1]]])
    top = [Camera(40, 30, 50.0, 50.0, 20.0, 15.0, turn, -turn @ [0, 0, 3.0]) for turn in above]
    order, why = arrange_cameras([*top, *level])
    assert "none in 360 degrees around its centre" in why
    assert sorted(order) == list(range(6))


def test_rounding_errors_do_not_change_the_order_of_a_ring():
    cameras = [ring_camera(k * 2 * np.pi / 48, 40, 30) for k in range(48)]
    noise = np.random.default_rng(0).normal(scale=1e-12, size=(48, 3))
    shaken = [
        Camera(40, 30, 50, 50, 20, 15, c.rotation, c.translation + d)
        for c, d in zip(cameras, noise, strict=True)
    ]
    assert arrange_cameras(cameras)[0] == arrange_cameras(shaken)[0] == list(range(48))


@given(st.integers(3, 60), st.integers(2, 9))
def test_sector_sizes_differ_by_at_most_one_and_matched_sizes_are_equal(count, sectors):
    sizes = [len(sector_range(count, part, sectors)) for part in range(sectors)]
    assert sum(sizes) == count
    assert max(sizes) - min(sizes) <= 1
    exactly = count // sectors
    matched = [sector_range(count, part, sectors, exactly) for part in range(sectors)]
    assert {len(part) for part in matched} == {exactly}
    assert all(set(part) <= set(range(count)) for part in matched)


def test_nearest_cameras_have_the_least_angle_and_the_least_distance():
    training, test = ring([0.0, 40.0, 90.0]), ring([10.0, 75.0])
    found = nearest_training_cameras(test, training, 2.0)
    for camera, entry in zip(test, found, strict=True):
        cosines = [float(camera.rotation[2] @ other.rotation[2]) for other in training]
        assert entry[ANGLE] == pytest.approx(np.degrees(np.arccos(max(cosines))), abs=1e-9)
        places = [float(np.linalg.norm(camera.center - other.center)) for other in training]
        assert entry[DISTANCE] == pytest.approx(min(places) / 2.0)
    assert nearest_training_cameras(training, training, 2.0) == [{ANGLE: 0.0, DISTANCE: 0.0}] * 3
    assert nearest_training_cameras(test, training[:1], 0.0)[0].keys() == {ANGLE}
    assert nearest_training_cameras(test, training, 0.5)[0][DISTANCE] == pytest.approx(
        4 * found[0][DISTANCE]
    )
    assert nearest_training_cameras([], training, 1.0) == []
