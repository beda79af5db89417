"""Photographs that a capture has twice: which are left out, and which are reported."""

import io
import logging
import shutil
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from gsbench.runs.trial_record import TwinViews
from gsbench.scene.twins import copies_by_name, without_copies
from gsbench.scene.types import Scene, View
from tests.helpers import refusal
from tests.scene.captures import read_colmap, read_photos
from tests.scene.conftest import smooth_image
from tests.scene.tables import TABLES
from tests.train.conftest import orbit_camera


@pytest.mark.parametrize("names, wanted, left_out", TABLES["copies by name"])
def test_one_of_several_photographs_with_the_same_stem_is_used(names, wanted, left_out):
    assert copies_by_name(names, wanted) == left_out


def photographs(folder, suffixes, count=9):
    folder.mkdir()
    for k in range(count):
        for suffix in suffixes:
            Image.fromarray(smooth_image(40, 30, seed=k)).save(folder / f"{k}{suffix}")
    return folder


def test_a_folder_with_every_photograph_in_two_formats_is_read_once(tmp_path, caplog):
    capture = read_photos(photographs(tmp_path / "own", (".jpg", ".png")))
    assert capture.image_names == tuple(f"{k}.jpg" for k in range(9))
    (line,) = [record.message for record in caplog.records]
    assert (
        "9 photographs left out, with the name or content of another: 0.png (0.jpg is used)" in line
    )
    alone = read_photos(photographs(tmp_path / "alone", (".jpg",)))
    assert (capture.fingerprint, alone.left_out) == (alone.fingerprint, {})


def test_a_training_file_with_the_content_of_a_test_view_is_left_out(make_scene):
    root = make_scene()
    shutil.copy(root / "images/00.png", root / "images/03.png")  # 00.png is the test view
    # copies within training are the user's choice
    shutil.copy(root / "images/04.png", root / "images/05.png")
    capture = read_colmap(root)
    assert capture.test_names == ("00.png",)
    assert capture.train_names == ("01.png", "02.png", "04.png", "05.png")
    assert capture.left_out == {"03.png": "00.png"}


def picture(seed):
    """A smooth picture with fine detail, [H, W, 3] uint8."""
    noise = np.random.default_rng(seed).normal(0, 12, (128, 160, 3))
    return (smooth_image(160, 128, seed) + noise).clip(0, 255).astype(np.uint8)


def encoded_again(image):
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, format="JPEG", quality=80)
    return np.asarray(Image.open(stream))


def scene_of(test, other, mask=None):
    camera = orbit_camera(0.1, 160, 128)
    views = [View(f"{k}.png", camera, picture(k)) for k in range(1, 4)]
    twin, held_out = View("twin.png", camera, other, mask), View("0.png", camera, test, mask)
    return Scene("made", (*views, twin), (held_out,))


@pytest.mark.parametrize(
    "change, left_out, is_near",
    [
        (lambda image: image.copy(), True, False),
        (encoded_again, False, True),
        (lambda image: np.roll(image, 1, axis=1), False, True),  # the next shot of a burst
        (lambda image: (image * 0.8).astype(np.uint8), False, True),  # another exposure
        (lambda image: image[:, ::-1].copy(), False, False),
        (lambda image: picture(77), False, False),
    ],
)
def test_equal_pixels_are_left_out_and_near_twins_are_found(change, left_out, is_near):
    scene = without_copies(scene_of(picture(0), change(picture(0))))
    assert len(scene.train) == (3 if left_out else 4)
    assert scene.twins.left_out == ({"twin.png": "0.png"} if left_out else {})
    assert scene.twins.near == ({"0.png": "twin.png"} if is_near else {})


@settings(max_examples=40, deadline=None)
@given(st.integers(40, 200), st.integers(-2, 2), st.integers(0, 4))
def test_a_near_twin_is_found_at_any_size(width, rounding, cut):
    image = picture(0)[: 128 - cut]
    height = round(128 * width / 160) + rounding
    small = np.asarray(Image.fromarray(image).resize((width, height), Image.Resampling.LANCZOS))
    twins = without_copies(scene_of(picture(0), small)).twins
    assert [*twins.near, *twins.left_out.values()] == ["0.png"]


def test_pixels_under_a_mask_do_not_make_photographs_different():
    mask = np.arange(160)[None, :].repeat(128, axis=0) < 120
    other = np.where(mask[..., None], picture(0), picture(9))
    scene = scene_of(picture(0), other, mask)
    assert without_copies(scene).twins.left_out == {"twin.png": "0.png"}
    assert without_copies(replace(scene, train=scene.train[:3])).twins.left_out == {}


def test_a_split_whose_training_views_are_all_copies_is_refused():
    view = View("0.png", orbit_camera(0.1, 160, 128), picture(0))
    with refusal("all of them are copies of test views"):
        without_copies(Scene("made", (replace(view, name="1.png"),), (view,)))


def test_flat_pictures_are_twins_only_if_they_are_equal(caplog):
    grey = np.full((128, 160, 3), 100, dtype=np.uint8)
    with caplog.at_level(logging.WARNING):
        assert without_copies(scene_of(grey, grey + 1)).twins == TwinViews()
        assert without_copies(scene_of(grey, grey)).twins.left_out == {"twin.png": "0.png"}


@pytest.mark.shared
@pytest.mark.parametrize(
    "capture, most", [("fox", 0.2), ("garfield", 0.0), ("monstree", 0.0), ("studio_room", 0.2)]
)
def test_few_neighbours_of_real_captures_are_near_twins(shared, capture, most):
    """Neighbouring views of a walk around an object differ enough to be trained on."""
    files = sorted((shared / "data" / capture / "images").iterdir())[:40]
    views = []
    for file in files:
        image = np.asarray(Image.open(file).convert("RGB").resize((160, 120)))
        views.append(View(file.name, orbit_camera(0.1, 160, 120), image))
    scene = Scene(capture, tuple(v for k, v in enumerate(views) if k % 8), tuple(views[::8]))
    assert len(without_copies(scene).twins.near) <= most * len(scene.test)
