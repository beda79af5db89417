"""The content of results.json after a training by gsbench, by another program and without one."""

import json
from dataclasses import replace
from functools import partial
from shlex import split
from types import SimpleNamespace

import pytest

from gsbench.config.compose import compose_one
from gsbench.init.base import GAUSSIANS_FILE, MODEL_FOLDER, REPORT_FILE
from gsbench.pipeline.results import cloud_hash, results_of, versions
from gsbench.pipeline.trial import source_files
from gsbench.raster.reference import ReferenceRasterizer
from gsbench.runs.configuration import sha256_of
from gsbench.runs.keys import EVALUATE, INIT, STAGES, TRAIN, Step
from gsbench.runs.store import Store
from gsbench.scene.types import Capture
from gsbench.train.proof import Proven
from tests.helpers import write

TRAINING = {
    "iterations": 7,
    "num_init_points": 3,
    "num_gaussians": 5,
    "causes": {"initial": 5},
    "scene_extent": 4.5,
    "seconds": 60.0,
    "compile_seconds": 20.0,
    "peak_memory_mb": 100.0,
    "machine": {"cpu": "c"},
    "checkout": {"commit": "abc", "edited": True},
}
PROGRAM = {"trained_by": {"program": "other", "version": "2"}}
PROGRAM |= {"evaluated_from": "model", "checkout": {}}
EVENTS = [{"step": 1, "cloned": 2, "pruned_size": 1}, {"step": 2, "cloned": 3}]


def write_all(files, folder):
    for name, content in files.items():
        write(folder / name, content)


@pytest.fixture
def made(tmp_path, tiny_scene):
    """A function that makes the results of a trial with the training ``TRAINING`` and changes."""
    words = f"scene=courtyard name=x runs={tmp_path} eval.primary=psnr seed=4"
    values = compose_one(split(words)).values
    store = Store(tmp_path / "store")
    capture = Capture("made", tmp_path, (), (), None, False, "0abc", "every eighth view")
    larger = replace(tiny_scene.test[0], camera=tiny_scene.test[0].camera.resized(80, 64))
    scene = replace(tiny_scene, test=(larger, *tiny_scene.test[1:]))

    def make(**changes):
        training = TRAINING | changes
        evaluation = {
            "metrics": {"psnr": 20.0},
            "unavailable": {"flip": "off"},
            "awaited": ["flip"],
        }
        events = "".join(json.dumps(event) + "\n" for event in EVENTS)
        files = {
            INIT: {
                REPORT_FILE: {"num_points": 3},
                f"{MODEL_FOLDER}/a.bin": "a",
                GAUSSIANS_FILE: "b",
                "other": "c",
            },
            TRAIN: {"training.json": training, "events.jsonl": events},
            EVALUATE: {"metrics.json": evaluation},
        }
        inputs = {"protocol": "paper-1", "training": training}
        steps = [Step(stage, inputs, partial(write_all, own)) for stage, own in files.items()]
        entries = {step.stage.name: store.get(step) for step in steps}
        raster = Proven(ReferenceRasterizer())
        return results_of(
            values, capture, scene, raster, entries, {"train": "2", "init": "1"}, ["a"]
        )

    make.values = values
    return make


def test_results_combine_the_results_of_the_steps(made):
    found = made()
    expected = {
        "experiment": "x",
        "scene": "courtyard",
        "init": "sfm",
        "densify": "volumetric",
        "seed": 4,
        "raster": "reference",
        "protocol": "paper-1",
        "iterations": 7,
        "num_init_points": 3,
        "num_gaussians": 5,
        "scene_extent": 4.5,
        "peak_memory_mb": 100.0,
        "metrics": {"psnr": 20.0},
        "unavailable": {"flip": "off"},
        "awaited": ["flip"],
        "train_views": 8,
        "test_views": 2,
        "resolution": (80, 64),
        "held_out": "every eighth view",
        "init_report": {"num_points": 3},
        "machine": {"cpu": "c"},
        "causes": {"initial": 5},
        "evaluated_from": None,
        "trained_by": None,
        "questions": ["a"],
    }
    assert {name: getattr(found, name) for name in expected} == expected
    assert found.seconds.keys() == {"init", "train", "evaluate", "compile"}
    assert (found.seconds["train"], found.seconds["compile"]) == (60.0, 20.0)
    assert found.hashes["data"] == "0abc"
    assert (found.events["cloned"], found.events["pruned_size"], found.events["added"]) == (5, 1, 0)
    assert (found.code.commit, found.code.edited) == ("abc", True)
    assert found.code.packages == {"init": "1", "train": "2"}
    assert found.code.stages == {stage.name: stage.version for stage in STAGES}


@pytest.mark.parametrize(
    "changes, unknown, timed",
    [
        ({"iterations": 0}, {"train_time", "total_time"}, False),
        (PROGRAM, set(), True),
        (PROGRAM | {"iterations": 0}, set(), True),
        (PROGRAM | {"peak_memory_mb": None}, {"peak_memory_mb"}, True),
    ],
)
def test_unknown_costs_are_unavailable(made, changes, unknown, timed):
    found = made(**changes)
    assert (found.evaluated_from, found.raster) == ("model", "reference")
    assert found.unavailable.keys() == {"flip"} | unknown
    assert ("train" in found.seconds) == timed
    assert (found.trained_by is None) == ("trained_by" not in changes)


def test_the_hash_of_a_cloud_covers_its_model_and_its_gaussians(tmp_path):
    store = Store(tmp_path)

    def hash_of(number, **changes):
        files = {f"{MODEL_FOLDER}/a.bin": "a", GAUSSIANS_FILE: "b", "report.json": "c"} | changes
        return cloud_hash(store.get(Step(INIT, {"number": number}, partial(write_all, files))).path)

    first = hash_of(0)
    assert hash_of(1, **{"report.json": "other"}) == first != sha256_of({})
    others = [hash_of(2, **{f"{MODEL_FOLDER}/a.bin": "x"}), hash_of(3, **{GAUSSIANS_FILE: "x"})]
    assert len({first, *others}) == 3


def test_versions_cover_python_and_the_installed_packages():
    found = versions()
    assert found["python"].startswith("3.")
    assert {"gsbench", "torch", "numpy", "pycolmap"} <= found.keys()
    assert None not in found.values()


def test_source_files_are_the_users_files_of_a_capture(tmp_path):
    parts = SimpleNamespace(eval=SimpleNamespace(regions=None), scene=SimpleNamespace(beside=[]))
    store, model = Store(tmp_path / "store"), {"cameras.bin", "images.bin", "points3D.bin"}
    write_all(dict.fromkeys(model, ""), tmp_path / "model")
    capture = Capture("own", tmp_path, ("a.png", "b.png"), (), None, False, "0")
    images = [tmp_path / "a.png", tmp_path / "b.png"]
    assert source_files(capture, parts, store) == images
    mask, listed = tmp_path / "m.png", tmp_path / "transforms.json"
    more = replace(capture, masks={"a.png": mask}, read_from=(listed,))
    assert source_files(more, parts, store) == [*images, mask, listed]
    with_model = source_files(replace(capture, model=tmp_path / "model"), parts, store)
    assert with_model[:2] == images
    assert {path.name for path in with_model[2:]} >= model
    assert source_files(replace(capture, images=store.root / "scene/key"), parts, store) == []
