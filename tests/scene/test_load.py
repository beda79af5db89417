"""From capture and model to a scene: undistortion, sizes, cache, missing poses."""

import logging
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

from gsbench.logs import no_progress
from gsbench.runs.store import Store
from gsbench.scene.colmap import plain_camera, read_model
from gsbench.scene.load import ImageToPrepare, load_scene, prepare_all
from gsbench.scene.rules import inspect
from gsbench.scene.types import CameraModel
from gsbench.scene.undistortion import flatten, largest_distortion, lens_findings, undistort
from tests.helpers import read_json, refusal
from tests.scene.captures import loaded, read_colmap
from tests.scene.tables import TABLES

WIDTH, HEIGHT = 200, 150
# Parameters beyond the focal length of 150 px and the centre, where small ones do not fit.
OWN_EXTRA = TABLES["distortions of their own"]
PLAIN = {"INVALID", "PINHOLE", "SIMPLE_PINHOLE", "EQUIRECTANGULAR"}
MODELS = sorted(set(pycolmap.CameraModelId.__members__) - PLAIN)


def lens(name, amount=1.0):
    """A camera of a model whose distortion is multiplied by ``amount``."""
    camera = pycolmap.Camera.create_from_model_name(1, name, 150.0, WIDTH, HEIGHT)
    places = list(camera.extra_params_idxs())
    neutral = np.array({"EUCM": [0.0, 1.0]}.get(name, [0.0] * len(places)))
    # radial and tangential coefficients of either sign, the higher the smaller
    usual = [0.05 * (-0.3) ** k for k in range(len(places))]
    params = np.array(camera.params)
    for place, focal in zip(camera.focal_length_idxs(), (150.0, 152.0), strict=False):
        params[place] = focal
    params[camera.principal_point_idxs()] = 99.0, 76.0
    params[places] = neutral + amount * (np.array(OWN_EXTRA.get(name, usual)) - neutral)
    camera.params = params
    return camera


@pytest.fixture
def in_process(monkeypatch):
    """Undistort in this process; other tests start one, as for users."""
    for module in ("load", "undistortion"):
        isolated = f"gsbench.scene.{module}.run_isolated"
        monkeypatch.setattr(isolated, lambda work, *given, what: work(*given))


# camera space
SPOTS = np.array([[x, y, 1.0] for x in (-0.3, 0.0, 0.35) for y in (-0.25, 0.05, 0.2)])


@pytest.mark.parametrize("name", MODELS)
def test_undistorted_spots_land_where_a_pinhole_sees_them(name):
    source = lens(name)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    image = np.zeros((HEIGHT, WIDTH))
    for spot in SPOTS:  # one soft spot where COLMAP's own distortion puts each point
        x, y = source.img_from_cam(spot)
        image += np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * 1.5**2))
    pixels = np.repeat((255 * image.clip(0, 1)).astype(np.uint8)[..., None], 3, axis=2)
    flat, pinhole = undistort(pixels, CameraModel(name, WIDTH, HEIGHT, tuple(source.params)))
    assert flat.shape == (pinhole.height, pinhole.width, 3)
    for spot in SPOTS:
        x, y = pinhole.fx * spot[0] + pinhole.cx, pinhole.fy * spot[1] + pinhole.cy
        assert 6 < x < pinhole.width - 6
        assert 6 < y < pinhole.height - 6
        left, top = int(x) - 5, int(y) - 5
        window = flat[top : top + 11, left : left + 11, 0].astype(float)
        ys, xs = np.mgrid[:11, :11] + 0.5
        center = np.array([(window * xs).sum(), (window * ys).sum()]) / window.sum()
        assert_allclose(center, [x - left, y - top], atol=0.12)


PERSPECTIVE = [name for name in MODELS if "FISHEYE" not in name]


@pytest.mark.parametrize(
    "name, amount", [*((name, 1.0) for name in MODELS), *((name, 1e-7) for name in PERSPECTIVE[:2])]
)
def test_a_point_is_seen_at_the_pixel_where_pycolmap_undistorts_it(
    make_scene, tmp_path, name, amount, in_process
):
    """With tiny coefficients, perspective models keep their pixels."""
    camera = {"size": (WIDTH, HEIGHT), "model": name, "params": lens(name, amount).params}
    capture = read_colmap(make_scene(("0.png", "1.png", "2.png"), **camera))
    scene = loaded(capture, tmp_path)
    model = pycolmap.Reconstruction(capture.model)
    source = model.cameras[1]
    for view in (scene.train[0], scene.test[0]):
        image = model.find_image_with_name(view.name)
        stored = np.asarray(Image.open(capture.images / view.name))
        if amount < 1.0:
            assert_array_equal(view.image, stored)
            wanted = source
        else:
            wanted = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), source)
            assert view.image.shape[:2] == (wanted.height, wanted.width)
        camera = view.camera
        for point in np.random.default_rng(0).uniform((-1, -1, 4), (1, 1, 6), (20, 3)):
            x, y, z = camera.rotation @ point + camera.translation
            seen = [camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy]
            assert_allclose(seen, wanted.img_from_cam(image.cam_from_world() * point), atol=1e-3)


def test_distortion_below_a_twentieth_of_a_pixel_is_ignored_and_above_it_is_not():
    # px from the centre; in units of the focal length, k moves a point at r by k r^3
    corner = np.hypot(WIDTH, HEIGHT) / 2
    for moved, ignored in ((0.049, True), (-0.049, True), (0.051, False), (-0.051, False)):
        params = [150.0, WIDTH / 2, HEIGHT / 2, moved / 150.0 / (corner / 150.0) ** 3]
        camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=params)
        assert largest_distortion(camera) == pytest.approx(abs(moved))
        assert plain_camera(camera).distorted is not ignored
    cancelling = [150, 150, 100, 75, 0.1, 0, 0, 0, 0, 0.1, 0, 0]  # (1 + .1 r^2) / (1 + .1 r^2)
    camera = pycolmap.Camera(model="FULL_OPENCV", width=WIDTH, height=HEIGHT, params=cancelling)
    assert plain_camera(camera) == CameraModel("PINHOLE", WIDTH, HEIGHT, (150, 150, 100, 75))


def inspect_lens(camera):
    inspect("lens", lens_findings({"a.png": camera}), "here")


@pytest.mark.parametrize("name, params, share", TABLES["lenses that turn back"])
def test_lenses_that_turn_back_inside_the_picture_are_refused(
    name, params, share, caplog, in_process
):
    camera = CameraModel(name, 160, 120, tuple(map(float, params)))
    ((found, *_),) = flatten([camera])
    assert found == pytest.approx(share, abs=0.01)
    said = rf"the camera of a.png \({name}: .*\) turns back .*: {found:.1%}"
    with refusal(said if share else None):
        inspect_lens(camera)
    assert not caplog.records


def test_a_small_fold_in_the_corners_is_reported(caplog):
    camera = CameraModel("SIMPLE_RADIAL", 160, 120, (90.0, 80.0, 60.0, -0.185))
    ((share, *_),) = flatten([camera])
    assert 0 < share < 0.01
    inspect_lens(camera)
    assert "turns back inside the picture" in caplog.text


def test_a_lens_that_leaves_little_of_the_photograph_is_reported(caplog):
    inspect_lens(CameraModel("OPENCV", 160, 120, (120.0, 120, 80, 60, -0.3, 0.1, 0, 0)))
    assert not caplog.records
    inspect_lens(CameraModel("OPENCV", 160, 120, (120.0, 120, 80, 60, -45, 1017, 0, 0)))
    assert "1017, 0, 0) leaves 51x38 of 160x120 px undistorted: check its lens" in caplog.text


def test_panoramas_are_refused(tmp_path):
    camera = CameraModel("EQUIRECTANGULAR", WIDTH, HEIGHT, (float(WIDTH), float(HEIGHT)))
    with refusal("EQUIRECTANGULAR"):
        undistort(np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8), camera)
    Image.new("RGB", (WIDTH, HEIGHT)).save(tmp_path / "a.png")
    image = ImageToPrepare(tmp_path / "a.png", camera, tmp_path / "b.png")
    with refusal("EQUIRECTANGULAR"):  # raised in the isolated process, too
        prepare_all([image], no_progress)


def test_images_are_prepared_sixteen_at_a_time_in_their_order(tmp_path):
    images, told = [], []
    for width in range(20, 56):
        source, target = tmp_path / f"{width}.png", tmp_path / "made" / f"{width}.png"
        Image.new("RGB", (width, 10)).save(source)
        camera = CameraModel("PINHOLE", width, 10, (5.0, 6.0, width / 2, 4.0))
        images.append(ImageToPrepare(source, camera, target, max_size=(width + 1) // 2))
    cameras = prepare_all(images, lambda *state: told.append(state))
    assert told == [("views", done, 36) for done in (16, 32, 36)]
    for image, camera in zip(images, cameras, strict=True):
        with Image.open(image.target) as made:
            assert made.size == (camera.width, camera.height) == ((image.camera.width + 1) // 2, 5)
        assert (camera.fy, camera.cy) == (3.0, 2.0)
        assert camera.cx == pytest.approx(camera.width / 2)


def test_views_without_changes_are_read_from_the_original_files(make_scene, tmp_path):
    root = make_scene()
    capture = read_colmap(root)
    scene = loaded(capture, tmp_path)
    assert [view.name for view in scene.test] == ["00.png"]
    assert len(scene.train) == 5
    for view in (*scene.train, *scene.test):
        assert_array_equal(view.image, Image.open(root / "images" / view.name))
        assert (view.camera.fx, view.camera.cx, view.camera.cy) == (50.0, 20.0, 15.0)
    assert not list((tmp_path / "cache").rglob("*.png"))
    # camera k is at x = -0.1 k; training views 1..5: mean -0.3, farthest 0.2 away
    assert scene.extent == pytest.approx(1.1 * 0.2)


def test_downscaled_and_distorted_views_come_back_from_the_store(
    make_scene, tmp_path, monkeypatch, in_process
):
    root = make_scene(size=(81, 60), model="SIMPLE_RADIAL", params=[70, 40, 30, 0.05])
    capture = read_colmap(root)
    done = []
    options = {"max_size": 40, "progress": lambda *step: done.append(step)}
    cache = tmp_path / "cache"

    def load(folder=cache, **others):
        return load_scene(capture, capture.model, Store(folder), **(options | others))

    first = load()
    assert done == [("views", 6, 6)]
    second = load()
    assert done == [("views", 6, 6)]  # nothing was prepared again
    for scene in (second, load(tmp_path / "other")):
        for a, b in zip(first.train, scene.train, strict=True):
            assert_array_equal(a.image, b.image)
            assert_array_equal(a.camera.rotation, b.camera.rotation)
            assert a.camera.params == b.camera.params
    camera = first.train[0].camera
    assert first.train[0].image.shape == (camera.height, camera.width, 3)
    assert camera.width == 40
    assert not list(cache.rglob("*.partial"))
    load(max_size=20, progress=no_progress)
    assert len(list(cache.glob("views/[!.]*"))) == 2
    with monkeypatch.context() as patched:
        patched.setattr("gsbench.runs.keys.edited", lambda states: {"scene": "edited"})
        load()
    assert done == [("views", 6, 6)] * 3  # images that other code prepared are not used
    model = read_model(capture.model)
    model.points3D[1].xyz += 1.0
    model.write_binary(capture.model)
    load()
    assert len(done) == 3  # no pixel depends on points
    model.cameras[1].params = [71.0, 40, 30, 0.05]
    model.write_binary(capture.model)
    load()
    assert len(done) == 4  # pixels depend on the cameras


def test_images_that_were_not_selected_are_not_prepared(make_scene, tmp_path):
    capture = read_colmap(make_scene(), max_images=3)
    loaded(capture, tmp_path, max_size=20)
    (file,) = (tmp_path / "cache").rglob("cameras.json")
    assert list(read_json(file)["views"]) == ["00.png", "02.png", "04.png"]
    assert sorted(path.name for path in file.parent.glob("*.png")) == [
        f"0000{k}.png" for k in range(3)
    ]


def test_a_file_of_another_shape_than_its_camera_is_refused(make_scene, tmp_path):
    capture = read_colmap(make_scene())
    Image.new("RGB", (40, 26)).save(capture.images / "01.png")
    with refusal(r"01\.png: the image is 40x26 px but its camera .* 40x30"):
        loaded(capture, tmp_path)


@pytest.mark.parametrize("name", ["cameras.json", "00000.png", "manifest.json"])
def test_stored_views_that_were_changed_are_prepared_again(name, make_scene, tmp_path, caplog):
    capture = read_colmap(make_scene())
    first = loaded(capture, tmp_path, max_size=20)
    (file,) = (tmp_path / "cache").rglob(name)
    file.write_bytes(file.read_bytes()[:100])
    again = loaded(capture, tmp_path, max_size=20)
    assert "is damaged" in caplog.text
    assert again.train[0].camera.fx == first.train[0].camera.fx
    assert_array_equal(first.train[0].image, again.train[0].image)


def test_a_photograph_that_changed_its_size_since_it_was_prepared_is_refused(make_scene, tmp_path):
    capture = read_colmap(make_scene())
    loaded(capture, tmp_path)
    file = capture.images / capture.train_names[0]
    with Image.open(file) as image:
        smaller = image.resize((image.width // 2, image.height // 2))
    smaller.save(file)
    with refusal("changed after it was prepared: run again"):
        loaded(capture, tmp_path)


def test_centred_moves_the_principal_point_only(make_scene, tmp_path):
    capture = read_colmap(make_scene(params=[50, 51, 18, 16]))
    used = loaded(capture, tmp_path)
    centred = loaded(capture, tmp_path, principal_point="centred")
    assert (used.train[0].camera.cx, used.train[0].camera.cy) == (18, 16)
    assert (centred.train[0].camera.cx, centred.train[0].camera.cy) == (20, 15)
    assert centred.train[0].camera.fy == 51
    assert_array_equal(used.train[0].image, centred.train[0].image)


def test_views_without_pose_are_left_out_with_a_count(make_scene, tmp_path, caplog):
    capture = read_colmap(make_scene(), test_every=3)
    placed = ("00.png", "01.png", "02.png", "04.png")
    capture = replace(capture, model=make_scene(names=placed, root="partial") / "sparse/0")
    with caplog.at_level(logging.WARNING):
        scene = loaded(capture, tmp_path)
    assert [view.name for view in scene.train] == ["01.png", "02.png", "04.png"]
    assert [view.name for view in scene.test] == ["00.png"]
    assert "scene toy: 2 views without a pose left out: 03.png, 05.png" in caplog.text
    two = make_scene(names=placed[:2], root="two") / "sparse/0"
    for change, said in (
        ({"model": two}, "2 images of 6 of scene toy have a pose"),
        ({"test_names": placed}, "no training view has a pose"),
        ({"test_names": ("03.png",)}, "no test view has"),
    ):
        with refusal(said):
            loaded(replace(capture, **change), tmp_path / "other")


def test_a_truncated_photo_is_named_and_leaves_no_cache(make_scene, tmp_path):
    root = make_scene(size=(80, 60))
    path = root / "images/03.png"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    capture = read_colmap(root)
    with refusal(r"03\.png: the image is damaged"):
        loaded(capture, tmp_path, max_size=20)
    assert not list((tmp_path / "cache").glob("views/[!.]*"))
