"""Photographs and the page's camera, against the cameras that they come from."""

import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation
from torch.testing import assert_close

from gsbench.normalization import Normalization
from gsbench.raster import create_rasterizer
from gsbench.scene.types import Camera, View
from gsbench.view.server import fitting_fov, level_up, mean_up, orbit_distance, page_camera
from gsbench.view.trials import (
    ViewedTrial,
    find_trial,
    load_viewed,
    model_file,
    model_folder,
    photograph_at,
    read_test_views,
    side_by_side,
)
from tests.gaussians.helpers import random_gaussians
from tests.helpers import read_json, refusal, write


def smooth_image(height, width):
    noise = np.random.default_rng(0).uniform(0, 255, (height, width, 3))
    blurred = gaussian_filter(noise, (4, 4, 0))
    return np.uint8(255 * (blurred - blurred.min()) / np.ptp(blurred))


def make_view(x=0.0):
    camera = Camera(80, 60, 70.0, 70.0, 38.0, 31.0, np.eye(3), np.array([-x, 0.0, 0.0]))
    return View("a.png", camera, smooth_image(60, 80))


def test_photograph_in_its_own_camera_is_itself():
    view = make_view()
    assert_array_equal(photograph_at(view.camera, view), view.image)


@pytest.mark.parametrize("scale", [2, 0.5])
def test_photograph_follows_the_focal_length_and_the_principal_point(scale):
    view = make_view()
    width, height = round(80 * scale), round(60 * scale)
    camera = view.camera.resized(width, height)
    resized = Image.fromarray(view.image).resize((width, height), Image.Resampling.BILINEAR)
    expected = np.asarray(resized, int)
    got = photograph_at(camera, view).astype(int)
    assert np.abs(got - expected)[4:-4, 4:-4].mean() < 3
    assert np.abs(got[:, ::-1] - expected).mean() > 15


@pytest.mark.parametrize("stripes", [np.s_[::2], np.s_[:, ::2]], ids=["rows", "columns"])
def test_fine_stripes_become_grey_in_a_smaller_picture(stripes):
    view = make_view()
    view.image[:] = 0
    view.image[stripes] = 255
    small = photograph_at(view.camera.resized(40, 30), view)
    assert np.abs(small[1:-1, 1:-1].astype(int) - 127).max() < 30


def test_panes_stand_side_by_side_with_labels():
    left, right = np.full((50, 60, 3), 40, np.uint8), np.full((50, 60, 3), 80, np.uint8)
    row = side_by_side([("a label far too long for such a small pane", left), ("b", right)])
    assert row.shape == (50, 120, 3)
    below, labels = row[20:], row[:20]
    assert (below[:, :59] == 40).all()
    assert (below[:, 62:] == 80).all()
    assert (labels[:, :60] != 40).any()
    assert (labels[:, 62:] != 80).any()
    assert (row[:, 57:60] == 40).all()  # the label was made to fit
    assert (below[:, 60] == 255).all()  # a line divides the panes
    pane = np.full((360, 100, 3), 90, np.uint8)  # its text has 10 px, and a margin of 5
    inked = (side_by_side([("B", pane), ("B", pane)])[:, :, 0] != 90).nonzero()
    assert 4 <= inked[0][inked[1] < 100].min() <= 9
    assert 4 <= inked[1].min() <= 6
    assert 104 <= inked[1][inked[1] > 101].min() <= 106


def test_page_camera_projects_as_the_page_does():
    turn = Rotation.from_euler("xyz", [0.3, -0.5, 1.1])
    x, y, z, w = turn.as_quat()
    position, fov, aspect = np.array([1.0, 2.0, -3.0]), 0.9, 1.6
    camera = page_camera(np.array([w, x, y, z]), position, fov, aspect, 200, 2)
    assert (camera.height, camera.width) == (200, 160)
    ahead = position + turn.apply([0, 0, 2.0])
    seen = camera.rotation @ ahead + camera.translation
    assert_allclose(seen, [0, 0, 2], atol=1e-12)
    top = position + turn.apply([0, -math.tan(fov / 2) * 2, 2.0])  # y is down
    seen = camera.rotation @ top + camera.translation
    assert camera.fy * seen[1] / seen[2] + camera.cy == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("aspect", [0.4, 1.0, 3.0])
def test_fitting_field_of_view_shows_the_whole_picture_and_no_more(aspect):
    fov = fitting_fov(make_view().camera, aspect)
    pane = page_camera(np.array([1.0, 0, 0, 0]), np.zeros(3), fov, aspect, 1000, 1)
    shown = []
    for u, v in ((0, 0), (80, 0), (80, 60), (0, 60)):
        x, y = (u - 38.0) / 70, (v - 31.0) / 70
        shown.append(((pane.fx * x + pane.cx) / pane.width, (pane.fy * y + pane.cy) / pane.height))
    corners = np.array(shown)
    assert corners.min() > -0.002
    assert corners.max() < 1.002
    assert min(corners.min(), 1 - corners.max()) < 0.002  # it touches an edge


@pytest.mark.parametrize("roll", [0.0, 0.4, math.pi])
def test_page_stands_upright_where_the_photograph_was_taken(roll):
    """The page builds its camera from forward and upward directions, as look-at cameras do."""
    turn = Rotation.from_euler("YXZ", [0.7, -0.5, roll]).as_matrix()
    camera = Camera(80, 60, 70.0, 70.0, 40.0, 30.0, turn.T, np.zeros(3))
    up = level_up(camera, np.array([0.0, -1.0, 0.0]))
    right = np.cross(camera.rotation[2], up)
    assert_allclose(right / np.linalg.norm(right), camera.rotation[0], atol=1e-12)
    assert np.linalg.norm(up) == pytest.approx(1)
    if roll == 0:
        assert_allclose(up, [0, -1, 0], atol=1e-12)


@pytest.mark.parametrize("up", [(0, 0, 1), (1, 0, 0)])
def test_without_an_upward_direction_in_the_picture_the_cameras_own_is_taken(up):
    """The camera looks straight up, or the direction is to its right."""
    assert_array_equal(level_up(make_view().camera, np.array(up, float)), [0, -1, 0])


def test_a_page_turns_around_the_middle_of_the_cameras_and_their_mean_direction():
    views = [make_view(x) for x in (0.0, 3.0, 9.0)]  # 4, 1 and 5 from their middle
    assert_allclose(mean_up(views), [0, -1, 0])
    assert orbit_distance(views) == pytest.approx(10 / 3)
    assert orbit_distance(views[:1]) == 1e-3
    opposite = replace(views[0], camera=replace(views[0].camera, rotation=np.diag([-1.0, -1, 1])))
    assert_array_equal(mean_up([views[0], opposite]), [0, 0, 1])


@pytest.mark.parametrize(
    "name, value",
    [
        ("wxyz", (1e-7, 0, 0, 0)),
        ("wxyz", (math.nan, 0, 0, 1)),
        *(("position", (x, 0, 0)) for x in (math.inf, 1e30)),
        *(("fov", value) for value in (math.pi, 0.0)),
        *(("aspect", value) for value in (1e6, 0.0, math.nan)),
    ],
)
def test_impossible_cameras_of_a_page_are_refused(name, value):
    sound = {"wxyz": (1, 0, 0, 0), "position": (1, 2, 3), "fov": 0.9, "aspect": 1.6}
    for aspect, width in ((0.11, 1), (1.6, 4), (9.9, 25)):
        pane = page_camera(**(sound | {"aspect": aspect}), height=5, panes=2)
        assert (pane.width, pane.height) == (width, 5)
    with pytest.raises(ValueError, match=r"no camera|is not drawn"):
        page_camera(**(sound | {name: value}), height=540, panes=1)


def test_a_trial_is_drawn_as_the_evaluation_renders_it():
    gaussians, camera = random_gaussians(40, seed=1, dtype=torch.float32), make_view().camera
    raster = create_rasterizer("reference", torch.device("cpu"))
    for background in ((0.0, 0.0, 0.0), (1.0, 0.5, 0.0)):
        trial = ViewedTrial("a", gaussians, (make_view(),), background, raster)
        with torch.no_grad():
            image = raster.render(gaussians, camera, 3, torch.tensor(background)).image
        assert_allclose(trial.draw(camera), np.round(255 * image.clamp(0, 1).numpy()), atol=1)


def configured(trial, **settings):
    values = {key.replace("__", "."): value for key, value in settings.items()}
    return replace(trial, settings={trial.key: values})


def test_a_trial_is_loaded_with_all_that_is_drawn(small_runs):
    trial = find_trial("small:courtyard:volumetric", small_runs)
    moved = replace(trial.record, normalization=Normalization((1.0, 2.0, 3.0), 2.0))
    viewed, there = (
        load_viewed(configured(one, train__background=[1.0, 0.5, 0.0]), None, torch.device("cpu"))
        for one in (trial, replace(trial, record=moved))
    )
    assert (viewed.label, viewed.background) == ("courtyard random-volumetric seed 0", (1, 0.5, 0))
    assert load_viewed(trial, None, torch.device("cpu")).background == (0, 0, 0)
    assert len(viewed.gaussians) == 40
    assert_close(there.gaussians.means, 2 * (viewed.gaussians.means - torch.tensor([1.0, 2, 3])))
    first, second = viewed.views
    camera = first.camera  # of a photograph of half the model's size
    assert (first.name, camera.width, camera.height) == ("view000.png", 64, 48)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (50, 55, 33.5, 23)
    assert_allclose(second.camera.center, [2, 2, 0])
    folder = model_folder(trial)
    camera = read_test_views(configured(trial, scene__principal_point="centred"), folder)[1].camera
    assert (camera.cx, camera.cy) == (24, 32)


def test_addresses_name_a_trial_by_its_arm_seed_or_folder(small_runs, tmp_path):
    first = find_trial("small:courtyard:adc", small_runs)
    assert (first.seed, first.densify) == (0, "adc")
    assert find_trial("small:courtyard:random-adc:1", small_runs).seed == 1
    assert find_trial(str(first.path), small_runs).path == first.path
    assert find_trial("small:garden:sfm-adc", small_runs).init == "sfm"
    for address, words in {
        "small:garden:adc": "names 2 complete trials; choose one of small:garden:random-adc:0 and small:garden:sfm-adc:0",
        "small:courtyard:mcmc": "small:courtyard:random-adc:0",
        "small:courtyard:adc:7": "small:courtyard:random-adc:0",
        "small:courtyard": "EXPERIMENT:SCENE:ARM",
        "small:courtyard:": "EXPERIMENT:SCENE:ARM",
        "small:courtyard:adc:0:0": "EXPERIMENT:SCENE:ARM",
        "nothing:courtyard:adc": "nothing",
        str(first.path.parent): "is not a trial's folder",
    }.items():
        with refusal(words):
            find_trial(address, small_runs)
    copy = Path(shutil.copytree(small_runs, tmp_path / "runs")) / first.path.relative_to(small_runs)
    write(copy / "results.json", read_json(copy / "results.json") | {"status": "running"})
    with refusal("is not a complete trial"):
        find_trial(str(copy), tmp_path / "runs")


def test_what_is_gone_from_a_trial_is_named(small_runs, tmp_path):
    shutil.copytree(small_runs, tmp_path / "runs")
    trial = find_trial("small:courtyard:adc", tmp_path / "runs")
    renders = replace(trial.record, evaluated_from="renders")
    with refusal("was evaluated from renders: it has no model"):
        model_file(replace(trial, record=renders))
    for folder, words in (
        (trial.path / "ground_truth", "holds no picture of a test view"),
        (tmp_path / "runs" / "store", "is gone: run this trial again"),
    ):
        shutil.rmtree(folder)
        with refusal(words):
            load_viewed(trial, None, torch.device("cpu"))
