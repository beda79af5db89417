"""The blocks and commands of the documents, and the examples, run as a reader would run them."""

import csv
import importlib
import json
import os
import re
import shlex
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from plyfile import PlyData, PlyElement

from gsbench.cli import run
from gsbench.densify import DensifyContext
from gsbench.gaussians.paper_values import LearningRates
from gsbench.gaussians.trainable import TrainableGaussians
from gsbench.raster.base import RenderOutput
from gsbench.scene.colmap import read_model
from tests.conftest import ROOT
from tests.gaussians.helpers import random_gaussians
from tests.helpers import read_json

pytestmark = pytest.mark.slow

BLOCK = re.compile(r"^```python\n(.*?)^```$", re.DOTALL | re.MULTILINE)
TINY = "scene=courtyard scene.views=8 scene.width=64 scene.height=48 train.iterations=5"
TINY += " init=random init.count=500 init.size=1.2 densify=none eval.lpips=[] tracking=none"


def run_blocks(document):
    """Run the Python blocks of a document in order, and return their variables."""
    text = document.read_text(encoding="utf-8")
    variables = {"__name__": "document"}
    for match in BLOCK.finditer(text):
        line = text[: match.start(1)].count("\n")
        exec(compile("\n" * line + match.group(1), str(document), "exec"), variables)
    return variables


def run_command(page, part, small=TINY):
    """Give the command of a page that has the text ``part``; ``small`` are settings that it lacks.

    Its seeds are replaced by those of ``small``, if any.
    """
    text = re.sub(r" *\\\n +", " ", (ROOT / f"docs/{page}").read_text(encoding="utf-8"))
    (found,) = [line for line in re.findall(r"^    gsbench (.*)$", text, re.M) if part in line]
    typed = [word for word in shlex.split(found) if not word.startswith("seed=")]
    keys = {word.split("=")[0] for word in typed}
    assert run([*typed, *(word for word in small.split() if word.split("=")[0] not in keys)]) == 0


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working folder with the examples, whose modules can be imported and are forgotten."""
    for key in os.environ:
        if key.startswith(("GSBENCH_", "MLFLOW_")):
            monkeypatch.delenv(key)
    monkeypatch.setenv("MLFLOW_DISABLE_TELEMETRY", "true")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    for example in (ROOT / "examples").glob("*.py"):
        shutil.copy(example, tmp_path)
        monkeypatch.delitem(sys.modules, example.stem, raising=False)  # of another test
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        if str(getattr(sys.modules[name], "__file__", None)).startswith(str(tmp_path)):
            del sys.modules[name]


def test_the_code_of_the_library_document_trains_and_resumes(folder):
    found = run_blocks(ROOT / "docs/library.md")
    assert sum(found["losses"][-10:]) < 0.9 * sum(found["losses"][:10])
    assert len(found["trained"]) > len(found["initial"])
    for name, tensor in found["trained"].tensors().items():
        torch.testing.assert_close(found["again"].tensors()[name], tensor, rtol=0, atol=0)


def test_the_densifier_of_its_document_runs(folder):
    schedule = " train.iterations=120 train.densify_start=20 train.densify_stop=100"
    schedule += " train.densify_interval=20 seed=0"
    small = TINY.replace(" train.iterations=5", schedule)
    run_command("densifier.md", "densify._target_=largest.SplitLargest", small)
    (trial,) = Path("runs").glob("largest/courtyard/random-largest/*/results.json")
    events = [json.loads(line) for line in trial.with_name("events.jsonl").open()]
    assert any(event["split_volume"] for event in events)
    for event in events:
        assert event["after"] == event["before"] + event["split_volume"] - event["pruned_opacity"]


def test_the_rasterizer_of_its_document_runs(folder):
    run_blocks(ROOT / "docs/rasterizer.md")
    run_command("rasterizer.md", "raster._target_=oversampled.Oversampled")
    assert len(list(Path("runs").glob("oversampled/courtyard/*/*/results.json"))) == 1


def test_the_metric_of_its_document_is_measured_and_shown(folder, capsys):
    early = "train.iterations=40 train.densify_start=5 train.densify_interval=5"
    small = TINY.replace("train.iterations=5", early)
    run_command("metric.md", "-m densify=adc,volumetric", f"{small} seed=0,1")
    capsys.readouterr()
    run_command("metric.md", "tables gradients", "")
    shown = capsys.readouterr()
    trials = sorted(
        path.parent for path in Path("runs").glob("gradients/courtyard/*/*/results.json")
    )
    assert len(trials) == 4
    for trial in trials:
        results = read_json(trial / "results.json")
        assert results["metric_facts"]["gradients"]["direction"] == -1
        assert list(results["code"]["sources"]) == ["gradients"]
        with (trial / "per_view.csv").open(newline="") as stream:
            rows = {row["view"]: float(row["gradients"]) for row in csv.DictReader(stream)}
        assert results["metrics"]["gradients"] == pytest.approx(np.mean(list(rows.values())))
        for view, value in rows.items():  # again, from the pictures that the trial left
            pair = [
                np.asarray(Image.open(trial / kind / view)).astype(float)
                for kind in ("renders", "ground_truth")
            ]
            sides = [
                np.abs(np.diff(pair[0], axis=axis) - np.diff(pair[1], axis=axis)).mean()
                for axis in (0, 1)
            ]
            assert value == pytest.approx(np.mean(sides), rel=1e-5)
    assert "gradient error (levels) ↓" in shown.out
    assert "**" not in shown.out.split("gradient error")[1]  # nobody asked, so no best is shown
    assert run(["report", "gradients"]) == 0
    report = Path("runs/gradients/report.html").read_text()
    assert "gradient error: left of zero is better" in report.replace(
        "gradient error (levels)", "gradient error"
    )


SCENE = " ".join(word for word in TINY.split() if not word.startswith("init"))


def test_the_initialiser_of_its_document_runs(folder):
    run_command("initialiser.md", "init._target_=shell.Shell", SCENE)
    (results,) = Path("runs").glob("shell/courtyard/shell-adc/*/results.json")
    values = read_json(results)
    assert values["num_init_points"] == 20_000
    assert values["init_report"]["init"] == "shell"


def test_a_cloud_from_a_file_keeps_as_many_points_as_asked_for(folder):
    points = np.random.default_rng(0).uniform([-2, -2, 0], [2, 2, 1], (5000, 3))
    vertices = points.view([(axis, "f8") for axis in "xyz"]).ravel()
    PlyData([PlyElement.describe(vertices, "vertex")]).write("scan.ply")
    assert run(f"{SCENE} init=points init.path=scan.ply init.max_points=900 name=scan".split()) == 0
    (scan,) = Path("runs").glob("scan/courtyard/points-none/*/results.json")
    assert read_json(scan)["num_init_points"] == 900


def test_the_tracker_of_its_document_gets_every_trial(folder):
    run_command("hydra.md", "kept.Kept", f"{TINY.replace(' tracking=none', '')} seed=0,1")
    shown = {one["tags"]["seed"]: one for one in map(read_json, Path("runs/told/shown").iterdir())}
    results = {one["seed"]: one for one in map(read_json, Path("runs/told").rglob("results.json"))}
    assert set(shown) == {"0", "1"}
    for seed, one in results.items():
        told = shown[str(seed)]
        assert told["metrics"]["eval/psnr_dB 5"] == one["metrics"]["psnr"]
        assert told["end"] == {"status": "FINISHED", "reason": None}
        assert "kept" not in one["code"]["sources"]  # a tracker changes no result


def test_the_reader_of_its_document_finds_the_cameras(folder):
    """The same training as with the cameras' COLMAP model, but for rounding."""
    run_blocks(ROOT / "docs/library.md")
    capture = folder / "library/courtyard"
    np.save(capture / "poses_bounds.npy", _llff(read_model(capture / "sparse/0")))
    small = " ".join(word for word in TINY.split() if not word.startswith("scene"))
    own = "scene=reader scene._target_=llff.LLFF allow_targets=[llff] name=llff"
    for words in (own, "scene=colmap scene.name=courtyard name=colmap"):
        assert run([*words.split(), f"scene.path={capture}", *small.split()]) == 0
    (own,), (colmap,) = (
        list(Path("runs", name).rglob("results.json")) for name in ("llff", "colmap")
    )
    assert read_json(own)["metrics"]["psnr"] == pytest.approx(
        read_json(colmap)["metrics"]["psnr"], abs=1e-3
    )
    assert list(read_json(own)["code"]["sources"]) == ["llff"]


def _llff(model):
    """The rows of LLFF's poses_bounds.npy: 3 x 5 numbers and two distances of each camera."""
    rows = []
    for image in sorted(model.images.values(), key=lambda image: image.name):
        right, down, forward = image.cam_from_world().rotation.matrix()
        camera = model.cameras[image.camera_id]
        size = [camera.height, camera.width, camera.focal_length_x]
        matrix = np.stack([down, right, -forward, image.projection_center(), size], axis=1)
        rows.append([*matrix.ravel(), 0, 1])
    return rows


@pytest.mark.parametrize(
    "file, name, options",
    [
        ("largest", "SplitLargest", {"interval": 1, "size": 0.05, "prune_opacity": 0.3}),
        ("careful", "Careful", {"interval": 2, "gradient_threshold": 0.5}),
    ],
)
def test_the_densifiers_of_the_document_resume_to_the_bit(folder, file, name, options):
    """They pass the checklist of the document."""
    cls = getattr(importlib.import_module(file), name)

    def rounds(state, first, last):
        """Run refinements ``first`` to ``last`` of a made-up training, from ``state`` if given."""
        densifier, rng = cls(start=0, stop=100, **options), torch.Generator()
        context, rates = DensifyContext(2.0), LearningRates()
        initial = random_gaussians(60, seed=1, dtype=torch.float32)
        gaussians = TrainableGaussians(initial, rates, 2.0)
        if state is None:
            densifier.begin(gaussians.values, context)
            rng.manual_seed(5)
        else:
            gaussians.load_state_dict(state[0])
            densifier.load_state_dict(state[1], context)
            rng.set_state(state[2])
        for step in range(first, last + 1):
            n, own = len(gaussians), torch.Generator().manual_seed(step)
            radii = torch.randint(0, 3, (n,), generator=own, dtype=torch.int32)
            points = torch.zeros(n, 2)
            points.grad = torch.rand(n, 2, generator=own)
            densifier.observe(step, RenderOutput(torch.zeros(1), torch.zeros(1), radii, points))
            event = densifier.refine(step, gaussians, rng)
            assert event is None or event.balances()
            assert len(gaussians) == len(densifier.lineage.ids)
            assert {len(own) for own in densifier.statistics.values()} == {len(gaussians)}
        return gaussians.state_dict(), densifier.state_dict(), rng.get_state()

    whole, resumed = rounds(None, 1, 8), rounds(rounds(None, 1, 5), 6, 8)
    assert len(whole[1]["lineage"]["ids"]) != 60
    for part, key in ((0, "gaussians"), (1, "lineage")):
        for name, tensor in whole[part][key].items():
            assert torch.equal(resumed[part][key][name], tensor), name


def test_the_governed_densifier_of_the_document_ends_at_its_limit(folder):
    from largest import SplitLargest

    gaussians, rng = random_gaussians(100), torch.Generator().manual_seed(0)
    densifier = SplitLargest(
        start=0, stop=500, max_gaussians=150, cap="governor", prune_opacity=0.0
    )
    densifier.begin(gaussians, DensifyContext(1.0))
    trainable = TrainableGaussians(gaussians, LearningRates(), 1.0)
    for step in (100, 200, 300, 400):
        densifier.statistics["seen"][:] = True
        event = densifier.refine(step, trainable, rng)
    assert abs(event.after - 150) <= 3
