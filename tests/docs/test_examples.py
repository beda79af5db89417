"""The Python blocks of the documents run, in order, as a reader would run them."""

import csv
import os
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from gsbench.cli import run
from gsbench.densify import ADC, DensifyContext
from gsbench.gaussians.paper_values import LearningRates
from gsbench.gaussians.trainable import TrainableGaussians
from gsbench.raster.base import RenderOutput
from tests.conftest import ROOT
from tests.gaussians.helpers import random_gaussians
from tests.helpers import read_json, write

pytestmark = pytest.mark.slow

BLOCK = re.compile(r"^```python\n(.*?)^```$", re.DOTALL | re.MULTILINE)
FILE = re.compile(r"# (\w+\.py)\n")  # the first line of a block that is a file of this name


def run_blocks(document, folder):
    """Write the blocks that are files to ``folder``, run the others, and return their variables."""
    text = document.read_text(encoding="utf-8")
    variables = {"__name__": "document"}
    for match in BLOCK.finditer(text):
        code = match.group(1)
        name = FILE.match(code)
        if name:
            (folder / name.group(1)).write_text(code, encoding="utf-8")
            continue
        line = text[: match.start(1)].count("\n")
        exec(compile("\n" * line + code, str(document), "exec"), variables)
    return variables


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty working folder, whose modules can be imported and are forgotten afterwards."""
    for key in os.environ:
        if key.startswith(("GSBENCH_", "MLFLOW_")):
            monkeypatch.delenv(key)
    monkeypatch.setenv("MLFLOW_DISABLE_TELEMETRY", "true")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in (
        "kept",
        "llff",
        "mine",
        "shell",
        "untiled",
    ):  # of other tests, or of another document
        monkeypatch.delitem(sys.modules, name, raising=False)
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        if str(getattr(sys.modules[name], "__file__", None)).startswith(str(tmp_path)):
            del sys.modules[name]


def test_the_code_of_the_library_document_trains_and_resumes(folder):
    found = run_blocks(ROOT / "docs" / "library.md", folder)
    assert sum(found["losses"][-10:]) < 0.9 * sum(found["losses"][:10])
    assert len(found["trained"]) > len(found["initial"])
    for name, tensor in found["trained"].tensors().items():
        torch.testing.assert_close(found["again"].tensors()[name], tensor, rtol=0, atol=0)


def test_the_densifier_of_its_document_runs(folder, capsys):
    found = run_blocks(ROOT / "docs" / "densifier.md", folder)
    assert found["status"] == 0, capsys.readouterr().err
    assert found["event"]["split_volume"] > 0
    results = list(Path("runs").glob("largest/courtyard/random-largest/*/results.json"))
    assert len(results) == 1


def test_the_rasterizer_of_its_document_runs(folder, capsys):
    found = run_blocks(ROOT / "docs" / "rasterizer.md", folder)
    assert found["status"] == 0, capsys.readouterr().err
    assert len(list(Path("runs").glob("untiled/courtyard/*/*/results.json"))) == 1


def test_the_metric_of_its_document_is_measured_and_shown(folder, capsys):
    found = run_blocks(ROOT / "docs" / "metric.md", folder)
    shown = capsys.readouterr()
    assert found["status"] == 0, shown.err
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
    # a direction is known, so the best is marked
    assert "**" in shown.out.split("gradient error")[1]
    assert run(["report", "gradients"]) == 0
    report = Path("runs/gradients/report.html").read_text()
    assert "gradient error: left of zero is better" in report.replace(
        "gradient error (levels)", "gradient error"
    )


def test_the_initialiser_of_its_document_runs(folder, capsys):
    """An initialiser from one file outside gsbench, through the real program."""
    found = run_blocks(ROOT / "docs" / "initialiser.md", folder)
    assert found["status"] == found["scan_status"] == 0, capsys.readouterr().err
    (scan,) = Path("runs").glob("scan/courtyard/points-none/*/results.json")
    assert read_json(scan)["num_init_points"] == 900
    (results,) = Path("runs").glob("shell/courtyard/shell-none/*/results.json")
    values = read_json(results)
    assert values["num_init_points"] == 500
    assert values["init_report"]["init"] == "shell"


def test_the_tracker_of_its_document_gets_every_trial(folder, capsys):
    found = run_blocks(ROOT / "docs" / "hydra.md", folder)
    assert found["status"] == 0, capsys.readouterr().err
    shown = {one["tags"]["seed"]: one for one in map(read_json, Path("runs/told/shown").iterdir())}
    results = {one["seed"]: one for one in map(read_json, Path("runs/told").rglob("results.json"))}
    assert set(shown) == {"0", "1"}
    for seed, one in results.items():
        told = shown[str(seed)]
        assert told["metrics"]["eval/psnr_dB 5"] == one["metrics"]["psnr"]
        assert told["end"] == {"status": "FINISHED", "reason": None}
        assert "kept" not in one["code"]["sources"]  # a tracker changes no result


def test_the_reader_of_its_document_finds_the_cameras(folder, capsys):
    """The same training as with the cameras' COLMAP model, but for rounding."""
    found = run_blocks(ROOT / "docs" / "library.md", folder)
    assert found["status"] == 0, capsys.readouterr().err
    scene = ["scene=colmap", "scene.path=library/courtyard", "scene.name=courtyard"]
    assert run([*scene, *found["quick"].split(), "name=colmap"]) == 0
    (own,), (colmap,) = (
        list(Path("runs", name).rglob("results.json")) for name in ("llff", "colmap")
    )
    assert read_json(own)["metrics"]["psnr"] == pytest.approx(
        read_json(colmap)["metrics"]["psnr"], abs=1e-3
    )
    assert list(read_json(own)["code"]["sources"]) == ["llff"]


def module_of(folder, name):
    """A module whose code is a block of the densifiers' document."""
    blocks = BLOCK.findall((ROOT / "docs" / "densifier.md").read_text())
    (code,) = (block for block in blocks if block.startswith(f"# {name}.py"))
    write(folder / f"{name}.py", code)
    return __import__(name)


def rounds(make, first, last, state=None, check=None):
    """Run refinements ``first`` to ``last`` of a made-up training, from ``state`` if given.

    Each has other radii and gradients. Returns the states of Gaussians, densifier and generator.
    """
    densifier, rng = make(), torch.Generator().manual_seed(5)
    context, rates = DensifyContext(2.0), LearningRates()
    if state is None:
        initial = random_gaussians(60, seed=1, dtype=torch.float32)
        gaussians = TrainableGaussians(initial, rates, 2.0)
        densifier.begin(gaussians.values, context)
    else:
        gaussians = TrainableGaussians.load(state[0], rates, 2.0)
        densifier.load_state_dict(state[1], context)
        rng.set_state(state[2])
    for step in range(first, last + 1):
        n, own = len(gaussians), torch.Generator().manual_seed(step)
        radii = torch.randint(0, 3, (n,), generator=own, dtype=torch.int32)
        points = torch.zeros(n, 2)
        points.grad = torch.rand(n, 2, generator=own)
        densifier.observe(step, RenderOutput(torch.zeros(1), torch.zeros(1), radii, points))
        event = densifier.refine(step, gaussians, rng)
        if check:
            check(event, gaussians, densifier)
    return gaussians.state_dict(), densifier.state_dict(), rng.get_state()


def check_resumed(make, cut, last, check=None):
    """The same bits come from a training in one piece and from one in two; returns its states."""
    whole = rounds(make, 1, last, check=check)
    resumed = rounds(make, cut + 1, last, rounds(make, 1, cut, check=check), check)
    for part, states in ((0, "gaussians"), (1, "lineage")):
        for name, tensor in whole[part][states].items():
            assert torch.equal(resumed[part][states][name], tensor), name
    return whole


def test_the_densifier_of_its_document_resumes_to_the_bit(folder):
    """It passes the checklist of the document."""
    largest = module_of(folder, "largest")
    settings = {"start": 0, "stop": 100, "interval": 1, "share": 0.1, "prune_opacity": 0.3}

    def check(event, gaussians, densifier):
        after = event.before + event.split_volume - event.pruned_opacity
        assert event.after == after == len(gaussians)
        assert len(densifier.lineage.ids) == len(gaussians)
        assert len(densifier.statistics["seen"]) == len(gaussians)

    check_resumed(lambda: largest.SplitLargest(**settings), 3, 6, check)


@pytest.mark.parametrize("module, name", [("careful", "Careful"), ("peak", "Peak")])
def test_the_examples_of_hooks_train_and_resume_to_the_bit(folder, module, name):
    settings = {"start": 0, "stop": 100, "interval": 2, "gradient_threshold": 0.5}
    cls = getattr(module_of(folder, module), name)
    whole = check_resumed(lambda: cls(**settings), 5, 8)
    plain = rounds(lambda: ADC(**settings), 1, 8)
    assert len(whole[1]["lineage"]["ids"]) != len(plain[1]["lineage"]["ids"])


def test_the_governed_densifier_of_the_document_ends_at_its_limit(folder):
    opaque = module_of(folder, "opaque")
    gaussians, rng = random_gaussians(100), torch.Generator().manual_seed(0)
    densifier = opaque.CloneOpaque(start=0, stop=500, max_gaussians=150, cap="governor")
    densifier.begin(gaussians, DensifyContext(1.0))
    trainable = TrainableGaussians(gaussians, LearningRates(), 1.0)
    for step in (100, 200, 300, 400):
        event = densifier.refine(step, trainable, rng)
        trainable.values.opacity_logits.data += 0.1 * torch.randn(len(trainable), generator=rng)
    assert abs(event.after - 150) <= 3


@pytest.mark.parametrize(
    "document", ["README.md", *(f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md"))]
)
def test_links_between_documents_lead_to_existing_files(document):
    path = ROOT / document
    for target in re.findall(r"\]\(([^)#]+?)(?:#[^)]*)?\)", path.read_text(encoding="utf-8")):
        if "://" not in target:
            assert (path.parent / target).exists(), f"{document} points to {target}"
