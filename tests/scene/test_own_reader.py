"""A user's own reader of captures: what it may return, and where its results are stored."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gsbench.config.compose import compose_one
from gsbench.errors import InputError
from gsbench.pipeline.parts import Parts
from gsbench.pipeline.steps.scene import CaptureSource
from gsbench.runs.code import UserCode
from gsbench.scene.colmap import read_model
from gsbench.scene.options import SceneConfig
from gsbench.scene.record import Photograph, RawCapture, read_own
from gsbench.scene.types import CameraModel
from tests.scene.tables import TABLES

CAMERA = CameraModel("PINHOLE", 32, 24, (30.0, 31.0, 16.0, 12.0))
POINTS = (np.arange(6.0).reshape(2, 3), np.zeros((2, 3), np.uint8))


@pytest.fixture
def folder(tmp_path):
    for number in range(4):
        pixels = np.full((24, 32, 3), 50 * number, np.uint8)
        Image.fromarray(pixels).save(tmp_path / f"{number}.png")
    return tmp_path


def posed(count=4):
    """Cameras on a line."""
    return raw(*(one(f"{n}.png", translation=np.array([0.1 * n, 0, 0])) for n in range(count)))


@dataclass
class Reader:
    result: Any = None
    scale: float = 1.0

    def read(self, folder):
        if isinstance(self.result, BaseException):
            raise self.result
        return posed() if self.result is None else self.result


def one(name="0.png", **changes):
    """A photograph whose camera, rotation or translation is changed."""
    values = {"camera": CAMERA, "rotation": np.eye(3), "translation": np.zeros(3)} | changes
    if isinstance(values["camera"], list):
        model, params = values["camera"]
        values["camera"] = CameraModel(model, 32, 24, tuple(params))
    return Photograph(name, Path(name), **values)


def raw(*photographs, **changes):
    return RawCapture(Path(), photographs, **({"points": POINTS} | changes))


FAULTS = [
    ({}, "read() must return gsbench.scene.record.RawCapture, got dict"),
    (KeyError("w"), "Reader cannot read {folder} (KeyError: 'w')"),
    (SystemExit(3), "Reader cannot read {folder} (SystemExit: 3)"),
    (raw(None), "?: "),
    (raw(points=([[1, 2]], POINTS[1])), "points must be finite numbers"),
    (raw(points="a.ply"), "points must be positions and colours"),
    (raw(points=(POINTS[0], POINTS[0])), "must be uint8 [P, 3]"),
    *((raw(one(**changes)), said) for changes, said in TABLES["faults of photographs"]),
]


@pytest.mark.parametrize("result, said", FAULTS)
def test_a_fault_of_the_reader_is_named(result, said, folder):
    with pytest.raises(InputError) as error:
        read_own(Reader(result), folder)
    assert said.format(folder=folder) in str(error.value)
    assert "test_own_reader.Reader" in str(error.value)
    assert "\n" not in str(error.value)


def source(folder, reader, code="a", **settings):
    options = SceneConfig(
        name="own", kind="reader", _target_="mine.Reader", path=str(folder), **settings
    )
    return CaptureSource(options, reader, UserCode({"mine": code}, {"scene": "mine.Reader"}))


def test_cameras_points_and_the_readers_own_split_reach_the_capture(folder, tmp_path):
    roles = ("train", "test", "train", "train")
    rows = [replace(row, role=role) for row, role in zip(posed().photographs, roles, strict=True)]
    own = raw(*rows, files=(folder / "0.png",))
    made = source(folder, Reader(own), split="list")
    step = made.step
    assert step is not None
    (tmp_path / "made").mkdir()
    step.build(tmp_path / "made")
    model = read_model(tmp_path / "made" / "sparse" / "0")
    positions = {i.name: i.cam_from_world().translation[0] for i in model.images.values()}
    assert positions == pytest.approx({f"{n}.png": 0.1 * n for n in range(4)})
    assert sorted(point.xyz.tolist() for point in model.points3D.values()) == POINTS[0].tolist()
    capture = made.read(tmp_path / "made")
    assert capture.test_names == ("1.png",)
    assert capture.read_from == (folder / "0.png",)


def test_results_are_stored_under_the_readers_code_its_settings_and_what_it_reads(folder):
    def key(reader, code="a"):
        step = source(folder, reader, code).step
        assert step is not None
        return step.key

    first = key(Reader())
    assert key(Reader()) == first
    assert key(Reader(scale=2.0)) != first
    assert key(Reader(), code="b") != first
    assert key(Reader(replace(posed(), points=None))) != first
    shifted = one(translation=np.array([0.5, 0, 0]))
    assert key(Reader(raw(shifted, *posed().photographs[1:]))) != first


@pytest.mark.parametrize("settings, said", TABLES["kinds of readers"])
def test_a_reader_goes_with_its_kind_of_scene(settings, said):
    with pytest.raises(InputError, match=said):
        SceneConfig(name="own", path="/a", **settings)


def test_options_of_the_reader_stand_among_the_settings_of_the_scene(monkeypatch, folder):
    monkeypatch.setitem(sys.modules, "mine", SimpleNamespace(Reader=Reader, __spec__=None))
    words = ["scene=reader", f"scene.path={folder}", "allow_targets=[mine,tests]"]
    words += ["scene._target_=mine.Reader", "+scene.scale=3"]
    parts = Parts(compose_one(words).values)
    assert parts.reader == Reader(scale=3.0)
    assert parts.scene.path == str(folder)
    for word, said in (("+scene.scael=3", "did you mean scale"), ("+scene.scale=x", "scene.scale")):
        with pytest.raises(InputError, match=said):
            _ = Parts(compose_one([*words[:-1], word]).values).reader
    assert "_target_" not in compose_one([]).values["scene"]  # earlier results keep their keys
    with pytest.raises(InputError, match=r"scene.scale is not a setting"):
        compose_one(["+scene.scale=3"])


def test_photographs_are_in_the_order_of_their_names(folder):
    """Test views are chosen by it, and a folder's order differs from file system to file system."""
    shuffled = raw(*reversed(posed().photographs))
    assert read_own(Reader(shuffled), folder).names == posed().names
