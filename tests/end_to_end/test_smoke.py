"""One short test of the program for each of its uses; part of ``make test``."""

import csv
import os
import re
import shlex
import sqlite3
import sys
from shlex import split

import numpy as np
import pytest
import torch
import yaml
from numpy.testing import assert_array_equal
from PIL import Image

from gsbench.cli import run
from gsbench.raster import create_rasterizer
from gsbench.view.trials import find_trial, load_viewed
from tests.conftest import ROOT
from tests.end_to_end.conftest import FINISHED, FINISHED_SWEEP, SMALL
from tests.helpers import read_json, write
from tests.processes import completed

TINY = [*SMALL, "train.iterations=20", "tracking=none", "eval.lpips=[]", "eval.flip=false"]
MORTAL = """
import os, signal
from dataclasses import dataclass
from pathlib import Path
from gsbench.densify import ADC

@dataclass
class Mortal(ADC):
    def after_step(self, step, gaussians, rng):
        if step == 150 and not Path("died").exists():
            Path("died").touch()
            os.kill(os.getpid(), signal.SIGKILL)
"""


def trials_of(runs, name=FINISHED):
    """The folders of finished trials by densifier and seed, such as ``adc-0``."""
    found = {}
    for path in sorted(runs.glob(f"{name}/*/*/*/results.json")):
        results = read_json(path)
        found[f"{results['densify']}-{results['seed']}"] = path.parent
    return found


def test_a_sweep_leaves_complete_trials(finished_runs):
    trials = trials_of(finished_runs)
    assert list(trials) == split("adc-0 adc-1 volumetric-0 volumetric-1")
    records = [read_json(trial / "results.json") for trial in trials.values()]
    for record in records:
        assert record["status"] == "complete"
        assert record["protocol"] == "paper-1"
        assert 13 < record["metrics"]["psnr"] < 40
        assert "lpips_squeeze" not in record["metrics"]
        assert "lpips_squeeze" in record["unavailable"]
        assert record["machine"]["cpu"]
    assert len({record["hashes"]["cloud"] for record in records}) == 1
    trial = trials["volumetric-0"]
    wanted = (
        "config.yaml per_view.csv metrics.jsonl events.jsonl renders ground_truth "
        "point_cloud.ply log.txt"
    )
    assert set(wanted.split()) <= {path.name for path in trial.iterdir()}
    with (trial / "per_view.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [row["view"] for row in rows] == ["0000.png", "0008.png"]
    picture = np.asarray(Image.open(trial / "renders/0000.png")).astype(float)
    truth = np.asarray(Image.open(trial / "ground_truth/0000.png")).astype(float)
    assert picture.shape == truth.shape == (72, 96, 3)
    assert 10 * np.log10(255**2 / ((picture - truth) ** 2).mean()) == pytest.approx(
        float(rows[0]["psnr"]), abs=1e-6
    )
    flipped = ((picture[::-1] - truth) ** 2).mean()
    # a PSNR alone would not show a flipped picture
    assert ((picture - truth) ** 2).mean() < 0.6 * flipped


@pytest.mark.slow
def test_the_viewer_draws_a_test_view_as_the_evaluation_did(finished_runs):
    cpu = torch.device("cpu")
    rasterizer = create_rasterizer("cpu", cpu)
    for trial in trials_of(finished_runs).values():
        viewed = load_viewed(find_trial(str(trial), finished_runs), rasterizer, cpu)
        assert [view.name for view in viewed.views] == ["0000.png", "0008.png"]
        for view in viewed.views:
            for folder, picture in (
                ("renders", viewed.draw(view.camera)),
                ("ground_truth", view.image),
            ):
                assert_array_equal(Image.open(trial / folder / view.name), picture)


def test_the_same_command_again_computes_nothing(said, runs, monkeypatch):
    monkeypatch.setenv("GSBENCH_RUNS", str(runs))
    written = [path.stat().st_mtime_ns for path in sorted(runs.rglob("results.json"))]
    said(*FINISHED_SWEEP)
    assert [path.stat().st_mtime_ns for path in sorted(runs.rglob("results.json"))] == written


def test_tables_and_report(said, runs, monkeypatch):
    monkeypatch.setenv("GSBENCH_RUNS", str(runs))
    assert re.search(r"\| courtyard \| random \| volumetric \|.* ± ", said("tables", FINISHED))
    said("report", FINISHED)
    page = (runs / f"{FINISHED}/report.html").read_text()
    assert page.count("<svg") >= 1
    assert "data:image/" in page


def test_a_killed_trial_continues_to_the_same_bits(gsbench, runs, tmp_path, monkeypatch, capsys):
    (tmp_path / "mortal.py").write_text(MORTAL)
    own = split(
        "densify=adc densify._target_=mortal.Mortal densify.name=mortal allow_targets=[mortal]"
    )
    command = [*SMALL, "name=killed", "tracking=none", *own]
    gsbench(*command, code=-9)
    assert not trials_of(runs, "killed")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("GSBENCH_RUNS", str(runs))
    assert run(command) == 0
    assert "iteration 120" in capsys.readouterr().err  # the checkpoint from which it continues
    (trial,) = trials_of(runs, "killed").values()
    whole = trials_of(runs)["adc-0"]
    for name in ("point_cloud.ply", "per_view.csv", "renders/0000.png"):
        assert (trial / name).read_bytes() == (whole / name).read_bytes()


@pytest.mark.slow
def test_the_densifier_in_the_readme_has_its_effect(gsbench, runs, tmp_path):
    (code,) = re.findall(
        r"```python\n(# mine\.py\n.*?)```", (ROOT / "README.md").read_text(), re.DOTALL
    )
    (tmp_path / "mine.py").write_text(code)
    own = split("densify=adc densify._target_=mine.Solid densify.name=solid allow_targets=[mine]")
    gsbench(*SMALL, *own, *split("name=own tracking=none +densify.min_opacity=0.3"))
    counts = [
        read_json(trial / "results.json")["num_gaussians"]
        for trial in (trials_of(runs, "own")["solid-0"], trials_of(runs)["adc-0"])
    ]
    assert counts[0] < counts[1]


@pytest.mark.slow
def test_the_recipe_of_the_readme_gives_a_declared_verdict_in_two_commands(gsbench, tmp_path):
    text = (ROOT / "README.md").read_text()
    (code,) = re.findall(r"```python\n(# mine\.py\n.*?)```", text, re.DOTALL)
    (experiment,) = re.findall(r"```yaml\n(# @package.*?)```", text, re.DOTALL)
    (tmp_path / "mine.py").write_text(code)
    write(tmp_path / "my/experiment/opacity.yaml", experiment)
    commands = re.findall(
        r"^    gsbench (--config-dir my .*?) +#.*$|^    gsbench (report opacity)$", text, re.M
    )
    first, second = (shlex.split(one or other) for one, other in commands)
    tiny = [
        *split("scene.width=96 scene.height=72 scene.views=12 init=random init.count=1000"),
        "train.steps_scaler=0.1",
        "densify.max_gaussians=1500",
        "eval.lpips=[]",
        "tracking=none",
    ]
    done = gsbench(*first, *tiny)
    asked, verdict = [line for line in done.stderr.splitlines() if " against " in line]
    assert asked.endswith("random-solid against random-adc: first on these seeds: 5 %")
    badge = re.fullmatch(r"random-solid against random-adc: ([A-Z]+), PSNR \(dB\) \S+", verdict)[1]
    gsbench(*second)
    page = (tmp_path / "runs/opacity/report.html").read_text()
    assert re.search(rf'class="badge [^"]*">{badge}<', page)


@pytest.mark.slow
def test_questions_of_a_file_and_their_archive(gsbench, runs, tmp_path):
    """A paper's claim is a question in an experiment's file, which an archive keeps."""
    settings = {word.split("=", 1)[0]: word.split("=", 1)[1] for word in TINY[1:]}
    question = {"idea": "none", "baseline": "adc", "metric": "psnr", "direction": "lower"}
    question |= {"least": 0.01, "says": "Growing helps.", "where": "Table 1"}
    content = {
        "name": "asked",
        "questions": [question],
        "hydra": {
            "mode": "MULTIRUN",
            "sweeper": {"params": settings | {"densify": "adc,none", "seed": "0,1"}},
        },
    }
    file = tmp_path / "my/experiment/asked.yaml"
    file.parent.mkdir(parents=True)
    file.write_text("# @package _global_\n" + yaml.safe_dump(content))
    gsbench("--config-dir my +experiment=asked")
    gsbench("report asked")
    page = (runs / "asked/report.html").read_text()
    assert "Growing helps." in page
    assert "Table 1" in page
    gsbench("export --results asked --out published.zip")
    gsbench("site published.zip --out site", GSBENCH_RUNS="elsewhere")
    (again,) = (tmp_path / "site").rglob("asked*.html")
    sentence = re.search(r"<p>(random-none against random-adc: [^<]+)", page)[1]
    assert sentence in again.read_text()
    assert not (tmp_path / "elsewhere").exists()


def test_a_mirror_in_mlflow(said, runs, monkeypatch):
    monkeypatch.setenv("GSBENCH_RUNS", str(runs))
    said("sync", FINISHED)
    wanted = [
        read_json(trial / "results.json")["metrics"]["psnr"] for trial in trials_of(runs).values()
    ]
    with sqlite3.connect(runs / "mlflow.db") as database:  # without MLflow's own code
        sent = [
            value
            for (value,) in database.execute(
                "SELECT value FROM latest_metrics WHERE key = 'eval/psnr_dB'"
            )
        ]
    # the parent run of each idea has the mean of its two seeds
    means = [sum(wanted[first : first + 2]) / 2 for first in (0, 2)]
    assert sorted(sent) == pytest.approx(sorted(wanted + means))


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="Slurm's commands are scripts of a shell here")
def test_slurms_job_command_runs_the_trial(gsbench, runs, tmp_path):
    """A stand-in for ``sbatch`` keeps the script, whose command is run as one task of the array."""
    bin_folder = tmp_path / "bin"
    bin_folder.mkdir()
    for name in ("sbatch", "srun", "squeue"):
        (bin_folder / name).write_text('#!/bin/sh\ncp "$1" "$KEPT"\necho Submitted batch job 7\n')
        (bin_folder / name).chmod(0o755)
    kept, path = tmp_path / "kept.sh", f"{bin_folder}{os.pathsep}{os.environ['PATH']}"
    cluster = split(
        "launch=slurm launch.wait=false launch.gpus_per_trial=0 launch.cpus_per_trial=1"
    )
    done = gsbench(
        *("-m", *TINY, "name=x", "seed=0,1", "densify=none", *cluster),
        PATH=path,
        KEPT=str(kept),
    )
    assert "Slurm job 7: 2 trials" in done.stdout
    script = kept.read_text()
    assert "#SBATCH --array=0-1" in script
    assert "#SBATCH --cpus-per-task=1" in script
    command = script[script.index(sys.executable) :].split()
    task = split("JOB_ID=7 ARRAY_JOB_ID=7 ARRAY_TASK_ID=1 JOB_NUM_NODES=1 NTASKS=1 PROCID=0")
    task += split("LOCALID=0 NODEID=0")
    task = dict(f"SLURM_{word}".split("=") for word in task) | {"SUBMITIT_EXECUTOR": "slurm"}
    completed(command, cwd=tmp_path, env=os.environ | task)
    assert list(trials_of(runs, "x")) == ["none-1"]
