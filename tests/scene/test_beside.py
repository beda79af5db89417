"""Pictures beside photographs: their pixels in the views that are trained."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

from gsbench.normalization import Normalization
from gsbench.scene.beside import files_beside, pixels_of_view, read_beside
from gsbench.scene.types import CameraModel, to_pinhole
from gsbench.scene.undistortion import flat_camera
from tests.helpers import refusal
from tests.scene.captures import loaded, read_colmap

STEPS = np.arange(12, dtype=np.uint16).reshape(3, 4) * 1000


@pytest.mark.parametrize(
    "name,values,expected",
    [
        ("a.png", STEPS, STEPS / 1000),
        ("a.tiff", STEPS.astype(np.float32), STEPS),
        ("a.npy", STEPS.astype(np.float64), STEPS),
        ("a.npy", STEPS.astype(np.int32), STEPS / 1000),
        ("a.npy", np.array([[np.nan, np.inf], [-1.0, 2.0]]), [[0, 0], [0, 2]]),
        ("a.npy", STEPS[..., None].astype(np.float32), STEPS),
    ],
)
def test_depth_is_in_world_units_and_0_where_it_is_not_known(tmp_path, name, values, expected):
    path = tmp_path / name
    np.save(path, values) if path.suffix == ".npy" else Image.fromarray(values).save(path)
    depth = read_beside(path, "depth")
    assert depth.dtype == np.float32
    assert_allclose(depth, expected, rtol=1e-6)


def test_a_step_of_integer_depth_has_the_size_that_is_given(tmp_path):
    Image.fromarray(STEPS).save(tmp_path / "a.png")
    assert_allclose(read_beside(tmp_path / "a.png", "depth", 0.25), STEPS * 0.25)


@pytest.mark.parametrize(
    "name,content,error",
    [
        ("a.png", np.zeros((2, 2, 3), np.uint8), "one number for each pixel"),
        ("a.npy", b"no array", "is no array of numpy"),
        ("a.npy", np.array([["x"]]), "one number for each pixel"),
    ],
)
def test_a_file_that_is_no_depth_is_refused_by_name(tmp_path, name, content, error):
    path = tmp_path / name
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif path.suffix == ".npy":
        np.save(path, content)
    else:
        Image.fromarray(content).save(path)
    with refusal(rf"a\.\w+: .*{error}"):
        read_beside(path, "depth")


def test_pixels_of_a_view_are_the_nearest_of_the_picture():
    picture = np.arange(6 * 8).reshape(6, 8)
    lens = CameraModel("PINHOLE", 80, 60, (70.0, 70.0, 40.0, 30.0))
    view = to_pinhole(lens).resized(20, 15)
    chosen = pixels_of_view(picture, lens, view, "a.png")
    for row in range(15):
        for column in range(20):
            assert (
                chosen[row, column] == picture[(2 * row + 1) * 6 // 30, (2 * column + 1) * 8 // 40]
            )


def test_pixels_of_an_undistorted_view_follow_the_lens():
    """Against COLMAP's own undistortion of a picture of the coordinates, which it interpolates."""
    lens = CameraModel("OPENCV", 120, 90, (100.0, 100.0, 60.0, 45.0, -0.2, 0.03, 0.001, 0.0))
    columns, rows = np.meshgrid(np.arange(120), np.arange(90))
    ramp = np.stack([2 * columns, 2 * rows, 0 * rows], axis=-1).astype(np.uint8)
    source = pycolmap.Camera(model=lens.name, width=120, height=90, params=lens.params)
    bitmap = pycolmap.Bitmap.from_array(ramp)
    flat, _ = pycolmap.undistort_image(pycolmap.UndistortCameraOptions(), bitmap, source)
    expected = np.array(flat.to_array()).astype(int)
    chosen = pixels_of_view(ramp, lens, flat_camera(lens), "a.png").astype(int)
    assert chosen.shape == expected.shape
    inside = (slice(2, -2), slice(2, -2))  # COLMAP blends the border with black
    assert np.abs(chosen - expected)[inside].max() <= 2  # one pixel


def test_a_picture_of_another_shape_is_refused():
    lens = CameraModel("PINHOLE", 480, 268, (400.0, 400.0, 240.0, 134.0))
    view = to_pinhole(lens).resized(96, 54)
    for size in ((134, 240), (67, 120), (34, 60), (300, 537)):
        assert pixels_of_view(np.zeros(size), lens, view, "a.npy").shape == (54, 96)
    for size in ((134, 160), (268, 400), (480, 268)):
        with refusal("a.npy: is .* px, and its photograph 480x268"):
            pixels_of_view(np.zeros(size), lens, view, "a.npy")


def test_a_kind_that_no_photograph_has_is_refused(make_scene):
    capture = read_colmap(make_scene())
    with refusal("scene.beside=depth: no photograph .* there are: none"):
        files_beside(capture, ["depth"])


def test_views_have_depth_in_the_units_of_the_training(make_scene, tmp_path):
    capture = read_colmap(make_scene())
    first, second = capture.image_names[:2]
    for name, value in ((first, 3000), (second, 5000)):
        path = tmp_path / f"{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.full((4, 4), value, np.uint16)).save(path)
    capture = replace(
        capture,
        beside={
            "depth": {name: tmp_path / f"{name}.png" for name in (first, second)},
            "normals": {first: capture.images / first},
        },
        normalization=Normalization(scale=2.0),
    )
    kinds = ["depth", "normals"]
    scene = loaded(capture, tmp_path, max_size=32, beside=kinds)
    views = {view.name: view for view in (*scene.train, *scene.test)}
    size = views[first].image.shape[:2]
    assert_allclose(views[first].beside["depth"], np.full(size, 6.0))
    assert_allclose(views[second].beside["depth"], np.full(size, 10.0))
    assert views[first].beside["normals"].shape == (*size, 3)
    assert "normals" not in views[second].beside
    plain = loaded(capture, tmp_path, max_size=32)
    assert not any(view.beside for view in plain.train)
    assert_array_equal(plain.train[0].image, scene.train[0].image)


def test_depth_that_no_view_knows_is_refused(make_scene, tmp_path, caplog):
    capture = read_colmap(make_scene())
    first = capture.image_names[0]
    np.save(tmp_path / "a.npy", np.full((30, 40), -1.0))
    capture = replace(capture, beside={"depth": {first: tmp_path / "a.npy"}})
    with refusal("scene.beside=depth: no view has a known depth"):
        loaded(capture, tmp_path, beside=["depth"])
    assert "scene.beside=depth: only 1 of 6 photographs have it" in caplog.text
