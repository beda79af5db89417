"""Regions of a scene's test views: the same for all arms, and refused where nothing gives them."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from PIL import Image

from gsbench.init.base import MODEL_FOLDER
from gsbench.pipeline.steps.regions import region_inputs, regions_of
from gsbench.scene.colmap import write_model
from gsbench.scene.types import Camera, Capture, View
from tests.helpers import refusal

NAMES = ("a.png", "b.png", "c.png")
SIZE = 24, 16  # px


def cameras(scale=1.0):
    return {
        name: Camera(*SIZE, 20.0, 20.0, 12.0, 8.0, np.eye(3), scale * np.array([0.2 * k, 0.0, 2.0]))
        for k, name in enumerate(NAMES)
    }


def points(scale=1.0):
    positions = np.random.default_rng(3).uniform([-2, -1, 0], [2, 1, 9], (60, 3))
    return scale * positions, np.zeros((60, 3), np.uint8)


@pytest.fixture
def case(tmp_path):
    """Parts, and the views of an arm whose own model is ten times as large as the scene's."""
    write_model(tmp_path / "own", cameras(), points())
    write_model(tmp_path / "init" / MODEL_FOLDER, cameras(10.0), points(10.0))
    capture = Capture("x", tmp_path, NAMES, NAMES[:2], tmp_path / "own", False, "f")
    seen = cameras(10.0)
    views = tuple(View(name, seen[name], np.zeros((*SIZE[::-1], 3), np.uint8)) for name in NAMES)
    store = SimpleNamespace(path=lambda step: tmp_path / "init")
    scene = SimpleNamespace(test=views[:2])
    parts = SimpleNamespace(
        eval=SimpleNamespace(regions="distance"),
        scene=SimpleNamespace(depth_scale=None, path=str(tmp_path)),
    )
    return SimpleNamespace(capture=capture, scene=scene, store=store, init=None), parts


def pictures(folder, values):
    for name, value in values.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(value).save(path)


def test_distances_are_those_in_the_scenes_own_model(case):
    found = regions_of(*case)
    total = sum(mask.sum() for own in found.values() for mask in own.values())
    assert total == 2 * SIZE[0] * SIZE[1]  # each pixel is in one region
    positions = points()[0]
    seen = positions + np.array([0.2, 0, 2])
    seen = seen[seen[:, 2] > 0]
    places = 20 * seen[:, :2] / seen[:, 2:] + np.array([12, 8])
    shown = ((places >= 0) & (places < SIZE)).all(axis=1)
    depths = {}
    for row in range(SIZE[1]):
        for column in range(SIZE[0]):
            gaps = np.linalg.norm(places[shown] - [column + 0.5, row + 0.5], axis=1)
            depths[row, column] = seen[shown][gaps.argmin(), 2]
    near, far = found["b.png"]["near"], found["b.png"]["far"]
    assert max(depths[at] for at in depths if near[at]) < min(
        depths[at] for at in depths if far[at]
    )


def test_depth_maps_of_a_sensor_come_before_the_model(case):
    views, parts = case
    ramp = np.arange(1, SIZE[0] * SIZE[1] + 1, dtype=np.uint16).reshape(SIZE[::-1])
    folder = Path(parts.scene.path) / "depths"
    pictures(folder, dict.fromkeys(NAMES, ramp))
    views.capture = replace(
        views.capture, beside={"depth": {name: folder / name for name in NAMES}}
    )
    found = regions_of(views, parts)
    for name in NAMES[:2]:
        assert_array_equal(found[name]["near"], ramp <= ramp.size / 3)
        assert_array_equal(found[name]["far"], ramp > 2 * ramp.size / 3)
    assert region_inputs(views, parts)["depth"].keys() == set(NAMES[:2])


def test_masks_give_regions_by_name(case):
    views, parts = case
    parts.eval.regions = {"sky": "masks"}
    half = np.zeros(SIZE[::-1], np.uint8)
    half[:5] = 255
    pictures(Path(parts.scene.path) / "masks", dict.fromkeys(NAMES, half))
    found = regions_of(views, parts)
    assert_array_equal(found["a.png"]["sky"], half > 0)
    before = region_inputs(views, parts)
    pictures(Path(parts.scene.path) / "masks", {NAMES[0]: 255 - half})
    assert region_inputs(views, parts) != before


def test_a_view_may_lack_a_region(case):
    views, parts = case
    parts.eval.regions = {"sky": "masks"}
    black = np.zeros(SIZE[::-1], np.uint8)
    pictures(Path(parts.scene.path) / "masks", dict.fromkeys(NAMES, black))
    assert not regions_of(views, parts)["a.png"]["sky"].any()


def test_distances_of_a_scene_without_points_are_refused(case, tmp_path):
    views, parts = case
    for model in (None, tmp_path / "bare"):
        if model is not None:
            write_model(model, cameras())
        views.capture = replace(views.capture, model=model)
        with refusal(
            "eval.regions=distance: the scene x has no depth maps and no model with points"
        ):
            region_inputs(views, parts)


def test_a_test_view_without_its_mask_is_refused(case):
    views, parts = case
    parts.eval.regions = {"sky": "masks"}
    pictures(Path(parts.scene.path) / "masks", {NAMES[0]: np.full(SIZE[::-1], 255, np.uint8)})
    with refusal("eval.regions.sky: no mask of b.png"):
        region_inputs(views, parts)
