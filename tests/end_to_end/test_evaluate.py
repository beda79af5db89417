"""Renders and models of other programs, measured by gsbench and entered beside its arms."""

import csv
import html
import json
import shutil
from pathlib import Path
from shlex import split

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from PIL import Image

from gsbench.cli import run
from gsbench.scene.types import ANGLE, DISTANCE
from tests.end_to_end.conftest import FINISHED, SMALL
from tests.helpers import read_json

pytestmark = pytest.mark.slow
EVAL = ["eval.lpips=[squeeze]", "eval.download=false"]
SCENE = split("scene.views=12 scene.width=96 scene.height=72")


@pytest.fixture
def runs(runs, monkeypatch, environment):
    """The folder of the finished experiment, for commands in this process."""
    monkeypatch.setenv("GSBENCH_RUNS", str(runs))
    monkeypatch.setenv("TORCH_HOME", environment["TORCH_HOME"])
    (runs / "mlflow.db").unlink(missing_ok=True)
    return runs


def trial(runs, arm="random-adc", seed=0):
    return next(runs.glob(f"{FINISHED}/courtyard/{arm}/*-seed{seed}"))


def results(folder):
    return read_json(folder / "results.json")


def views(folder):
    with (folder / "per_view.csv").open() as stream:
        return {row.pop("view"): row for row in csv.DictReader(stream)}


def better_renders(runs, folder, seed):
    """Renders nearer to the photographs than those of the arm, with names of another program."""
    folder.mkdir()
    own = trial(runs, seed=seed)
    for file in (own / "renders").glob("*.png"):
        mixed = Image.blend(
            Image.open(file), Image.open(own / f"ground_truth/{file.name}"), 0.5 + 0.05 * seed
        )
        mixed.save(folder / f"render_{int(file.stem)}.png")
    return folder


def test_renders_of_a_trial_are_measured_with_its_metrics_to_the_last_digit(said, runs):
    own = trial(runs)
    for truth, settings in (
        (str(own), []),
        (f"{FINISHED}:courtyard:adc:0", []),
        ("courtyard", SCENE + EVAL),
    ):
        found = json.loads(said(f"evaluate {own}/renders --truth {truth} --json", *settings))
        assert found["metrics"] == results(own)["metrics"]
        assert found["protocol"] == "paper-1"
        for view, row in views(own).items():
            metrics = {key: value for key, value in row.items() if key not in (ANGLE, DISTANCE)}
            assert {key: repr(value) for key, value in found["views"][view].items()} == metrics
    truth = f"--truth {own}/ground_truth --protocol standard"
    assert "protocol standard-1" in said(f"evaluate {own}/renders {truth}")


def test_entered_renders_are_in_the_table_and_get_a_verdict(said, refused, runs, tmp_path):
    for seed in (0, 1):
        folder = better_renders(runs, tmp_path / f"theirs{seed}", seed)
        done = said(f"evaluate {folder} --truth courtyard --as {FINISHED}:theirs --seed {seed}")
        assert "names matched apart from what all names begin" in done
    entered = trial(runs, "random-theirs", 1)
    found = results(entered)
    assert found["evaluated_from"] == "renders"
    assert found["num_gaussians"] is None
    assert list(views(entered)) == list(views(trial(runs)))
    picture = np.asarray(Image.open(entered / "renders/0008.png"))
    assert_array_equal(picture, np.asarray(Image.open(tmp_path / "theirs1/render_8.png")))

    page = html.unescape(said(f"tables {FINISHED} --format html"))  # it has all notes
    assert (
        "Renders of another program, measured as they are (its conditions are not known): "
        "random-theirs." in page
    )
    row = next(line for line in said(f"tables {FINISHED}").splitlines() if "theirs" in line)
    assert row.count("n/a") == 3  # LPIPS (not asked for), Gaussians, time
    assert "**" not in row  # nobody asked beforehand, so nothing is shown to be best
    said(f"report {FINISHED}")
    text = (runs / f"{FINISHED}/report.html").read_text()
    assert "NOT ASKED" in text
    assert "by a training elsewhere, which left no record" in text
    for verb in ("status {}", "explain {}:courtyard:psnr:theirs", "sync {}"):
        said(verb.format(FINISHED))
    for verb in ("view", "export --out x.ply"):
        assert "renders" in refused(verb, f"{FINISHED}:courtyard:theirs")


def test_folders_of_renders_are_compared_without_any_trial(runs, tmp_path, monkeypatch, capsys):
    """Photographs are in one folder, the renders of two methods in two others."""
    truth = Path(shutil.copytree(trial(runs) / "ground_truth", tmp_path / "photographs"))
    monkeypatch.setenv("GSBENCH_RUNS", str(tmp_path / "empty"))
    for arm, seed in (("ours", 0), ("theirs", 1)):
        folder = better_renders(runs, tmp_path / arm, seed)
        assert (
            run([*split(f"evaluate {folder} --truth {truth} --as new:{arm} --scene toy"), *EVAL])
            == 0
        )
    capsys.readouterr()
    assert run(["tables", "new"]) == 0
    table = capsys.readouterr().out
    assert "| toy | renders | theirs | " in table
    assert "**" not in table  # nobody asked beforehand, so no best is shown


def test_a_model_from_a_ply_is_measured_like_a_trained_one(said, runs, tmp_path):
    """With train=none and init=ply, a PLY is only rendered; a trial's own one gives its metrics."""
    model = tmp_path / "theirs.ply"
    shutil.copyfile(trial(runs) / "point_cloud.ply", model)
    scene = [word for word in SMALL if word.startswith(("scene", "eval"))]
    place = f"init.path={model} name={FINISHED} densify.name=model"
    said(*scene, *split(f"init=ply init.name=random train=none densify=none {place}"))
    found = results(trial(runs, "random-model"))
    assert found["metrics"] == results(trial(runs))["metrics"]
    assert found["evaluated_from"] == "model"
    assert found["num_gaussians"] == results(trial(runs))["num_gaussians"]
    assert "not compared" not in said(f"tables {FINISHED}")
    page = said(f"tables {FINISHED} --format html")
    assert "A model that another program trained, rendered here" in page
