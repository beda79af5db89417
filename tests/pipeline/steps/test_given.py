"""What steps pass on: training views and settings to another program, cameras to an initialiser."""

import json
import shlex
import sys
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from PIL import Image
from torch.testing import assert_close

from gsbench.densify import ADC, Volumetric
from gsbench.errors import TrainingError
from gsbench.external.settings import External
from gsbench.gaussians.ply import read_ply, write_ply
from gsbench.init import Random
from gsbench.init.base import GAUSSIANS_FILE, MODEL_FOLDER
from gsbench.normalization import Normalization
from gsbench.pipeline.steps import external as external_steps
from gsbench.pipeline.steps import train as train_steps
from gsbench.pipeline.steps.external import external_step
from gsbench.pipeline.steps.scene import init_step
from gsbench.pipeline.steps.train import _log_normalization, train_step
from gsbench.raster.reference import ReferenceRasterizer
from gsbench.runs.code import UserCode
from gsbench.runs.keys import INIT, Step
from gsbench.runs.store import Store
from gsbench.scene.colmap import model_points, read_model, write_model
from gsbench.scene.types import Capture, Scene, View
from gsbench.system.programs import SAFE_PATH
from gsbench.train.ideas import NO_IDEAS
from gsbench.train.options import TrainConfig
from tests.gaussians.helpers import random_gaussians
from tests.helpers import read_json, refusal
from tests.train.conftest import orbit_camera

CLOUD_STEP = Step(INIT, {}, lambda folder: None)
PROGRAM = """
import json, os, shutil, sys
data, output, model, *rest = sys.argv[1:]
there = sorted(os.path.relpath(os.path.join(at, name), data) for at, _, names in os.walk(data) for name in names)
print(json.dumps({"there": there, "rest": rest,
                  "own": [name for name in os.environ if name.startswith("GSBENCH_")], "set": os.environ.get("SET")}))
if model != "none":
    shutil.copy(model, output + "/result.ply")
"""


@pytest.fixture
def views(tmp_path):
    """Four training views and two test views of noise, and a cloud of seven points."""
    rng = np.random.default_rng(0)
    made = [
        View(f"{k}.png", orbit_camera(0.1 * k), rng.integers(0, 256, (32, 40, 3), np.uint8))
        for k in range(6)
    ]
    store = Store(tmp_path / "store")
    cloud = (rng.normal((0, 0, 4), size=(7, 3)), rng.integers(0, 256, (7, 3), np.uint8))
    write_model(
        store.path(CLOUD_STEP) / MODEL_FOLDER,
        {view.name: view.camera for view in made},
        cloud=cloud,
    )
    scene = Scene("made", tuple(made[2:]), tuple(made[:2]))
    capture = Capture("made", tmp_path, (), (), None, False, "0")
    return SimpleNamespace(
        capture=capture, inputs={"capture": "0"}, init=CLOUD_STEP, store=store, scene=scene
    )


def parts_of(seed=5):
    return SimpleNamespace(
        values={"densify": {"name": "other"}},
        train=SimpleNamespace(iterations=900),
        seed=seed,
        threads=3,
        device=torch.device("cpu"),
        initializer=Random(),
    )


def trainer(tmp_path, model, **settings):
    (tmp_path / "program.py").write_text(PROGRAM)
    words = ["{data}", "{output}", model]
    rest = ["{iterations}", "{seed}", "{device}", "{threads}", "{kind}"]
    command = [sys.executable, str(tmp_path / "program.py"), *words, *rest]
    return External(
        command=command,
        result="*.ply",
        version="7",
        options={"kind": "a b"},
        environment={"SET": "{seed}"},
        **settings,
    )


def test_a_program_gets_the_training_views_and_the_settings(views, tmp_path, monkeypatch):
    monkeypatch.setenv("GSBENCH_RUNS", "here")
    write_ply(random_gaussians(9, dtype=torch.float32), tmp_path / "model.ply")
    program = trainer(tmp_path, str(tmp_path / "model.ply"))
    step = external_step(views, program, parts_of())
    folder = tmp_path / "built"
    folder.mkdir()
    step.build(folder)
    said = json.loads((folder / "trainer.log").read_text().splitlines()[-1])
    assert [name for name in said["there"] if name.startswith("images")] == [
        f"images/{k}.png" for k in range(2, 6)
    ]
    assert "sparse/0/points3D.bin" in said["there"]
    assert said["rest"] == ["900", "5", "cpu", "3", "a b"]
    assert (said["own"], said["set"]) == ([], "5")
    summary = read_json(folder / "training.json")
    assert (summary["num_gaussians"], summary["num_init_points"], summary["iterations"]) == (
        9,
        7,
        900,
    )
    assert summary["trained_by"]["command"][2:4] == ["{data}", "{output}"]
    assert summary["trained_by"]["version"] == "7"
    assert summary["seconds"] > 0
    assert summary["peak_memory_mb"] > 0
    assert (step.stage.version, step.inputs["contract"]) == (1, 1)  # numbers that developers raise
    assert sorted(path.name for path in folder.iterdir()) == [
        "events.jsonl",
        "lineage.npz",
        "point_cloud.ply",
        "trainer.log",
        "training.json",
    ]
    keys = {external_step(views, program, parts_of(seed)).key for seed in (5, 6)}
    assert len(keys) == 2
    assert step.key in keys


def test_a_program_works_in_the_given_coordinates_and_its_model_is_normalized(views, tmp_path):
    normalization = Normalization((5e5, 5.4e6, 300.0), 0.01)
    views.capture = replace(views.capture, normalization=normalization)
    given = tmp_path / "given.ply"
    write_ply(random_gaussians(9, dtype=torch.float32), given, normalization)
    copied = tmp_path / "copied"
    code = (
        f"import shutil, sys; shutil.copytree(sys.argv[1], {str(copied)!r}); "
        f"shutil.copy({str(given)!r}, sys.argv[2])"
    )
    program = External(
        command=[sys.executable, "-c", code, "{data}", "{output}"], result="*.ply", version="7"
    )
    folder = tmp_path / "built"
    folder.mkdir()
    external_step(views, program, parts_of()).build(folder)
    seen, inside = (
        read_model(copied / MODEL_FOLDER),
        read_model(views.store.path(CLOUD_STEP) / MODEL_FOLDER),
    )
    for view in views.scene.train:
        center = seen.find_image_with_name(view.name).projection_center()
        assert_allclose(
            center, np.array(normalization.center) + view.camera.center / 0.01, atol=1e-6
        )
    wanted_points = np.array(normalization.center) + model_points(inside)[0] / 0.01
    assert_allclose(model_points(seen)[0], wanted_points, atol=1e-6)
    kept, wanted = read_ply(folder / "point_cloud.ply"), random_gaussians(9, dtype=torch.float32)
    assert_close(kept.means, wanted.means, atol=1e-6, rtol=0)
    assert_close(kept.log_scales, wanted.log_scales, atol=1e-5, rtol=0)


@pytest.mark.parametrize("minutes, limit", [(2.5, 150.0), (None, None)])
def test_a_program_runs_with_the_given_time_limit(views, tmp_path, monkeypatch, minutes, limit):
    given = []
    ended = SimpleNamespace(seconds=1.0, peak_memory_mb=1.0)
    monkeypatch.setattr(external_steps, "run_program", lambda *rest: given.append(rest) or ended)
    step = external_step(views, trainer(tmp_path, "none", time_limit_minutes=minutes), parts_of())
    with pytest.raises(TrainingError, match="ended well, but"):
        step.build(tmp_path)
    ((command, log_file, output, environment, seconds),) = given
    assert command[:2] == [sys.executable, str(tmp_path / "program.py")]
    assert (log_file, output) == (tmp_path / "trainer.log", tmp_path / "work/output")
    assert environment["SET"] == "5"
    assert seconds == limit


def test_a_program_gets_the_environment_without_variables_of_gsbench(tmp_path, monkeypatch):
    for name, value in (("GSBENCH_X", "1"), ("KEPT", "2"), SAFE_PATH):
        monkeypatch.setenv(name, value)
    found = external_steps.environment_of(trainer(tmp_path, "none"), {"seed": 5})
    assert (found.get("GSBENCH_X"), found.get("KEPT"), found.get(SAFE_PATH[0]), found["SET"]) == (
        None,
        "2",
        None,
        "5",
    )
    monkeypatch.setenv(SAFE_PATH[0], "1")  # the user's own value, not gsbench's
    assert (
        external_steps.environment_of(trainer(tmp_path, "none"), {"seed": 5})[SAFE_PATH[0]] == "1"
    )


def test_a_training_writes_its_model_lineage_and_summary(views, tmp_path, monkeypatch, told):
    reset = []
    monkeypatch.setattr(train_steps, "reset_peak_memory", reset.append)
    logged = []
    monkeypatch.setattr(train_steps, "_log_normalization", lambda *given: logged.append(given))
    cpu = torch.device("cpu")
    parts = SimpleNamespace(
        trainer=ADC(),
        rasterizer=ReferenceRasterizer(),
        train=TrainConfig(iterations=2),
        ideas=NO_IDEAS,
        seed=5,
        device=cpu,
        measured_earlier=[1],
        user_code=UserCode(),
        initializer=Random(),
    )
    step = train_step(views, parts)
    assert step.inputs["snapshots"] == [1]
    assert {
        "name",
        "log_every",
        "checkpoint_every",
        "checkpoint_minutes",
        "volume_histogram",
        "steps_scaler",
    }.isdisjoint(step.inputs["train"])
    folder = tmp_path / "built"
    folder.mkdir()
    step.build(folder)
    summary = read_json(folder / "training.json")
    assert (summary["iterations"], summary["num_init_points"], summary["num_gaussians"]) == (
        2,
        7,
        7,
    )
    assert summary["causes"]["initial"] == 7
    assert len(read_ply(folder / "point_cloud.ply", cpu)) == 7
    with np.load(folder / "lineage.npz") as lineage:
        assert len(lineage["ids"]) == 7
    assert reset == [cpu]
    assert logged == [(views.capture, parts.trainer)]
    assert told[-1][:3] == ("iteration", 2, 2)
    parts.measured_earlier = []
    assert "snapshots" not in train_step(views, parts).inputs


def test_training_starts_from_the_gaussians_of_the_initialiser_if_there_are_any(views):
    init, cpu = views.store.path(CLOUD_STEP), torch.device("cpu")
    assert len(train_steps.initial_gaussians(init, cpu)) == 7
    write_ply(random_gaussians(9, dtype=torch.float32), init / GAUSSIANS_FILE)
    assert len(train_steps.initial_gaussians(init, cpu)) == 9


def test_a_program_without_a_result_is_named_with_its_log(views, tmp_path):
    step = external_step(views, trainer(tmp_path, "none"), parts_of())
    (tmp_path / "built").mkdir()
    with pytest.raises(TrainingError, match=r"ended well, but .*; log: .*trainer\.log"):
        step.build(tmp_path / "built")
    assert not any((tmp_path / "built/work").glob("data/*"))


def test_the_version_that_a_program_prints_must_contain_the_set_one(views, tmp_path):
    write_ply(random_gaussians(9, dtype=torch.float32), tmp_path / "model.ply")
    for said, fits in (("other 7.1", True), ("other 8", False)):
        tells = f"{shlex.quote(sys.executable)} -c \"print('{said}')\""
        step = external_step(
            views, trainer(tmp_path, str(tmp_path / "model.ply"), version_command=tells), parts_of()
        )
        folder = tmp_path / said
        folder.mkdir()
        with refusal(None if fits else r"densify\.version"):
            step.build(folder)
            assert read_json(folder / "training.json")["trained_by"]["said"] == said


def test_a_program_is_refused_for_a_capture_with_masks(views, tmp_path):
    views.capture = replace(views.capture, masks={"0.png": tmp_path})
    with refusal("gets no masks"):
        external_step(views, trainer(tmp_path, "none"), parts_of())


@dataclass
class Noting:
    """An initialiser that writes down its reference."""

    count: int = 3
    name = "noting"

    def content(self):
        return "c"

    def run(self, capture, folder, report, reference):
        (folder / "given").write_text(str(reference))


@pytest.mark.parametrize("has_reference", [False, True])
def test_an_initialiser_gets_the_reference_cameras_and_they_are_in_its_key(
    tmp_path, has_reference, told
):
    Image.new("RGB", (4, 4)).save(tmp_path / "a.png")
    store, capture = (
        Store(tmp_path / "store"),
        Capture("made", tmp_path, ("a.png",), (), None, False, "0"),
    )
    reference = CLOUD_STEP if has_reference else None
    step = init_step(store, capture, Noting(), reference)
    step.build(tmp_path)
    assert told == [("photographs", 1, 1)]
    assert (tmp_path / "given").read_text() == str(
        store.path(CLOUD_STEP) / MODEL_FOLDER if has_reference else None
    )
    assert step.inputs["reference"] == (CLOUD_STEP.key if has_reference else None)
    assert step.inputs["options"]["count"] == 3
    others = [
        init_step(store, capture, Noting(4), reference),
        init_step(store, replace(capture, fingerprint="1"), Noting(), reference),
        init_step(store, replace(capture, test_names=("a.png",)), Noting(), reference),
    ]
    assert len({step.key, *(other.key for other in others)}) == 4
    (tmp_path / "a.png").write_bytes(b"torn")
    with refusal(r"a\.png"):
        step.build(tmp_path)


def test_the_volume_threshold_is_logged_in_units_of_the_scene(views, logged):
    """Twice as large in the training, a volume is eight times as large there."""
    moved = replace(views.capture, normalization=Normalization((1.0, 2.0, 3.0), 2.0))
    _log_normalization(moved, Volumetric(volume_threshold=0.004))
    assert "densify.volume_threshold=0.004 is 0.0005 cubed units of the scene" in logged.text
    logged.clear()
    _log_normalization(views.capture, Volumetric())
    assert not logged.text
