"""The photographs of a trial: the steps that make them, replace pixels and keep the test views."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from PIL import Image

from gsbench.normalization import Normalization
from gsbench.pipeline.steps import scene as scene_steps
from gsbench.pipeline.steps.scene import (
    MODEL_FOLDER,
    CaptureSource,
    Views,
    ground_truth_step,
    masked_capture,
    masking_step,
    normalizing_step,
)
from gsbench.runs.keys import INIT, Step
from gsbench.runs.store import Store
from gsbench.scene.beside import read_mask
from gsbench.scene.options import SceneConfig
from gsbench.scene.types import Capture
from tests.helpers import refusal
from tests.scene.captures import read_photos


@pytest.fixture
def photographs(tmp_path):
    """Four photographs with masks that ignore the upper half; b is transparent on its left half."""
    for index, name in enumerate(("a", "b", "c", "d")):
        pixels = np.full((20, 30, 4), [10, 20, 30, 255], np.uint8)
        pixels[19, 29, 2] += 0 if name == "b" else index  # makes all photographs different
        pixels[:, :15, 3] = 0 if name == "b" else 255
        (tmp_path / "photos/images").mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels if name == "b" else pixels[..., :3]).save(
            tmp_path / f"photos/images/{name}.png"
        )
        (tmp_path / "photos/masks").mkdir(exist_ok=True)
        counts = np.repeat([[0], [255]], 10, axis=0).astype(np.uint8).repeat(30, axis=1)
        Image.fromarray(counts).save(tmp_path / f"photos/masks/{name}.png.png")
    return tmp_path / "photos"


def test_the_courtyard_has_a_step_and_photographs_are_read_directly(photographs):
    made = CaptureSource(
        SceneConfig(name="made", kind="courtyard", views=9, width=40, height=30, seed=3)
    ).step
    assert {"views": 9, "width": 40, "height": 30, "seed": 3}.items() <= made.inputs.items()
    source = CaptureSource(SceneConfig(name="own", kind="photos", path=str(photographs)))
    assert source.step is None
    capture = source.read(None)
    assert capture.image_names == ("a.png", "b.png", "c.png", "d.png")
    assert not capture.masks
    with_masks = CaptureSource(
        SceneConfig(name="own", kind="photos", path=str(photographs), masks="masks")
    )
    assert with_masks.read(None).masks.keys() == set(capture.image_names)
    small = SceneConfig(name="own", kind="photos", path=str(photographs), max_size=20)
    with refusal(r"a\.png: 20x13 px of 30x20 are left with scene\.max_size=20"):
        CaptureSource(small).read(None)


def test_a_capture_is_moved_to_the_coordinates_of_the_training_by_a_step(photographs, monkeypatch):
    moved = []
    monkeypatch.setattr(scene_steps, "normalize_capture", lambda *given: moved.append(given))
    capture = read_photos(photographs)
    assert normalizing_step(capture) is None
    far = replace(capture, advised_normalization=Normalization((1e6, 0.0, 0.0), 0.5))
    step = normalizing_step(far)
    assert step.inputs["normalization"] == {"center": (1e6, 0.0, 0.0), "scale": 0.5}
    step.build(photographs)
    assert moved == [(far, photographs / MODEL_FOLDER)]


def test_masked_and_transparent_pixels_are_replaced(photographs, tmp_path, told):
    bare, masks = (
        read_photos(str(photographs)),
        read_photos(str(photographs), masks="masks"),
    )
    assert masking_step(bare, "black") is None  # reading makes transparent pixels black anyway
    steps = [
        masking_step(capture, behind)
        for capture, behind in ((bare, "white"), (masks, "white"), (masks, "black"))
    ]
    assert len({step.key for step in steps if step is not None}) == 3
    for name, step in zip(("white", "both", "masks"), steps, strict=True):
        step.build(tmp_path / name)
    # the progress ends at all four photographs
    assert told == [("pixels replaced", done, 4) for done in (1, 2, 3, 4)] * 3
    read = {
        name: np.asarray(Image.open(tmp_path / f"{name}/images/b.png").convert("RGB"))
        for name in ("white", "both")
    }
    assert (read["white"][:, :15] == 255).all()
    assert (read["white"][:, 15:] == [10, 20, 30]).all()
    assert (read["both"][10:, :15] == 255).all()
    found = masked_capture(masks, tmp_path / "both")
    assert found.images == tmp_path / "both/images"
    for name in masks.image_names:
        assert_array_equal(read_mask(found.masks[name]), read_mask(masks.masks[name]))
    assert masked_capture(bare, tmp_path / "white").masks == {}


def test_ground_truth_has_the_test_views_and_their_masks(tmp_path, tiny_scene):
    counts = np.zeros((32, 40), dtype=bool)
    counts[:, 7:] = True
    scene = replace(tiny_scene, test=(tiny_scene.test[0], replace(tiny_scene.test[1], mask=counts)))
    views = SimpleNamespace(scene=scene, inputs={}, init=Step(INIT, {}, lambda folder: None))
    ground_truth_step(views).build(tmp_path)
    assert sorted(path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.png")) == [
        "00.png",
        "08.png",
        "masks/08.png",
    ]
    for view in scene.test:
        assert_array_equal(np.asarray(Image.open(tmp_path / view.name)), view.image)
    assert_array_equal(read_mask(tmp_path / "masks/08.png"), counts)


def test_each_setting_that_changes_views_changes_the_key(tmp_path):
    capture = Capture("own", tmp_path, ("a", "b", "c"), ("a",), None, False, "0")
    init, store = Step(INIT, {}, lambda folder: None), Store(tmp_path / "store")
    base = SceneConfig(name="own", kind="photos", path=str(tmp_path))
    changes = [
        {},
        {"max_size": 100},
        {"principal_point": "centred"},
    ]
    keys = [
        ground_truth_step(Views(store, capture, init, replace(base, **change))).key
        for change in changes
    ]
    others = [replace(capture, test_names=("b",)), replace(capture, fingerprint="1")]
    keys += [ground_truth_step(Views(store, other, init, base)).key for other in others]
    keys.append(
        ground_truth_step(
            Views(store, capture, Step(INIT, {"a": 1}, lambda folder: None), base)
        ).key
    )
    assert len(set(keys)) == len(keys) == 6
    assert (
        ground_truth_step(Views(store, capture, init, replace(base, max_images=9))).key == keys[0]
    )
