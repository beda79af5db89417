"""Another program as an arm: its inputs, the trials made of its results, and its failures."""

import hashlib
import html
import os
import re
import signal
import sys
import time
import zipfile
from functools import partial
from pathlib import Path
from shlex import split

import numpy as np
import pytest
import torch
from PIL import Image

from gsbench.cli import run
from gsbench.datasets.catalog import read_catalog
from gsbench.scene.courtyard.render import render_courtyard
from gsbench.view.trials import find_trial, load_viewed
from tests.datasets.server import serve
from tests.end_to_end.conftest import program
from tests.helpers import read_json, write
from tests.processes import is_running, wait_until

pytestmark = pytest.mark.slow

TRAINER = Path(__file__).with_name("trainer.py")
CLOUD = f"""
defaults: [/densify/external/program@_here_, _self_]
name: cloud
command: ["{{python}}", {TRAINER}, --data, "{{data}}", --output, "{{output}}", --iterations, "{{iterations}}",
  --seed, "{{seed}}", --mode, "{{mode}}"]
version: 1.2.3
version_command: ["{{python}}", {TRAINER}, --version]
result: point_cloud/iteration_{{iterations}}/*.ply
options: {{python: {sys.executable}, mode: good}}
environment: {{PAINTER: "{{mode}}"}}
"""
QUICK = [
    *split(
        "init=random init.count=2000 train.iterations=40 train.densify_start=500 tracking=none "
        "eval.lpips=[squeeze] eval.download=false"
    ),
    f"allow_targets=['{sys.executable}',PAINTER]",
]
COURTYARD = ["scene.views=12", "scene.width=96", "scene.height=72", *QUICK]


@pytest.fixture(scope="module")
def trainers(tmp_path_factory):
    """A folder of configurations with the trainer: a user's own YAML file."""
    folder = tmp_path_factory.mktemp("conf")
    write(folder / "densify/cloud.yaml", CLOUD)
    return folder


@pytest.fixture(scope="module")
def home(tmp_path_factory, environment, trainers):
    """A folder with a fetched scene, and a sweep of an arm of gsbench and one of another program."""
    home = tmp_path_factory.mktemp("home")
    train = partial(program, environment, home / "runs", cwd=home)
    courtyard = home / "courtyard"
    render_courtyard(courtyard, views=12, width=96, height=72, seed=0)
    (archives := home / "archives").mkdir()
    dataset = read_catalog()["mipnerf360"]
    archive = next(archive for archive in dataset.archives if "garden" in archive.scenes)
    with zipfile.ZipFile(archives / archive.name, "w") as content:
        for file in sorted(path for path in courtyard.rglob("*") if path.is_file()):
            name = file.relative_to(courtyard).as_posix().replace("images/", "images_4/")
            content.write(file, f"{archive.scenes['garden']}/{name}")
    with serve(archives) as server:
        train("fetch mipnerf360 garden --mirror", server.url)
    sweep = split("densify=adc,cloud seed=0,1 name=three scene=garden")
    train("--config-dir", trainers, "-m", *QUICK, *sweep)
    return home


HANG = split("densify=cloud densify.options.mode=hang")


def own(trainers):
    return ["--config-dir", str(trainers)]


def pids_in(log):
    """The ids of the trainer and its child, as it printed them."""
    lines = [line.split() for line in log.read_text().splitlines()]
    return [int(word) for first, *rest in filter(None, lines) if first == "pids" for word in rest]


def trial(home, arm, seed=0):
    return next((home / "runs").glob(f"three/garden/random-{arm}/*-seed{seed}"))


def results(folder):
    return read_json(folder / "results.json")


def pixels(path):
    return hashlib.sha256(np.asarray(Image.open(path)).tobytes()).hexdigest()


def test_a_program_is_compared_with_an_arm_of_gsbench(home, monkeypatch, said):
    monkeypatch.setenv("GSBENCH_RUNS", str(home / "runs"))
    monkeypatch.chdir(home)
    table = said("tables three")
    adc, cloud = (
        next(line for line in table.splitlines() if f"| {arm} |" in line)
        for arm in ("adc", "cloud")
    )
    assert "2.0" in cloud  # thousand Gaussians: one for each point
    assert adc.count("n/a") == cloud.count("n/a") == 1  # LPIPS
    assert (
        "its model rendered by gsbench (its time is that of the whole program, and it sets its "
        "own budget): random-cloud (version 1.2.3)."
    ) in html.unescape(said("tables three --format html"))  # with all notes
    said("report three")
    report = (home / "runs/three/report.html").read_text()
    assert re.search("random-cloud against random-adc: (better|worse)", report)
    assert "4 done" in said("status three")
    explained = said("explain three:garden:psnr:cloud")
    assert f"program   1.2.3: {sys.executable} {TRAINER}" in explained
    said("sync three")


def test_a_trial_of_another_program_has_a_full_record(home):
    model = results(trial(home, "cloud"))
    assert model["evaluated_from"] == "model"
    assert model["trained_by"]["said"] == "painter 1.2.3"
    assert model["num_gaussians"] == model["num_init_points"] == 2000
    assert model["iterations"] == 40
    assert model["seconds"]["train"] > 0.1
    assert 20 < model["peak_memory_mb"] < 4000  # an interpreter with numpy
    viewed = load_viewed(
        find_trial("three:garden:cloud:0", home / "runs"), None, torch.device("cpu")
    )
    assert (len(viewed.gaussians), len(viewed.views)) == (2000, 2)
    assert model["hashes"]["train"] != results(trial(home, "cloud", 1))["hashes"]["train"]
    assert not list((home / "runs/store").rglob("work"))


def test_no_test_photograph_reaches_another_program(home):
    """The trainer lists every file beside and below its input, and follows links."""
    log = (trial(home, "cloud") / "trainer.log").read_text()
    seen = dict(line.split()[1:] for line in log.splitlines() if line.startswith("saw "))
    truth = trial(home, "cloud") / "ground_truth"
    held_out = {file.name: pixels(file) for file in truth.glob("*.png")}
    photographs = {file.name: pixels(file) for file in (home / "data/garden/images_4").iterdir()}
    training = photographs.keys() - held_out.keys()
    assert len(held_out) == 2
    assert len(training) == 10
    assert {photographs[name] for name in held_out} == set(held_out.values())
    assert {Path(name).name: found for name, found in seen.items() if name.endswith(".png")} == {
        name: photographs[name] for name in training
    }
    assert not set(seen.values()) & set(held_out.values())
    assert {str(Path(name).parent) for name in seen if "sparse" in name} == {"data/sparse/0"}
    assert "observations 0" in log
    assert "environment [] good" in log


def test_a_finished_trial_is_not_repeated_and_another_version_is_another_trial(
    home, trainers, monkeypatch, capsys
):
    monkeypatch.setenv("GSBENCH_RUNS", str(home / "runs"))
    monkeypatch.chdir(home)
    words = [*own(trainers), *QUICK, *split("scene=garden densify=cloud name=three")]

    def written():
        stored = (home / "runs/store").glob("*/*/manifest.json")
        return {path: path.stat().st_mtime_ns for path in stored}

    before = written()
    assert run(words) == 0
    # the time limit is no part of the result's key
    assert run([*words, "name=again", "densify.time_limit_minutes=7"]) == 0
    assert written() == before
    capsys.readouterr()
    assert run([*words, "densify.version=9", "--dry-run"]) == 0
    assert "missing" in capsys.readouterr().out
    assert run([*words, "densify.version=9"]) == 2
    assert "says 'painter 1.2.3'" in capsys.readouterr().err


BAD = {
    "exit": "ended early (exit code 1); its last lines: Error: the painter has no paint; log: ",
    "nothing": "left no point_cloud/iteration_40/*.ply (densify.result); it wrote notes.txt; log: ",
    "nan": "f_dc_1 is not a finite number everywhere",
}


def test_each_bad_program_is_reported_in_one_line_and_the_other_trials_run(
    trainers, tmp_path, monkeypatch, capsys
):
    monkeypatch.setenv("GSBENCH_RUNS", str(tmp_path))
    words = [*own(trainers), "-m", *COURTYARD, "densify=cloud", "name=bad"]
    assert run([*words, f"densify.options.mode={','.join([*BAD, 'good'])}"]) == 1
    error = capsys.readouterr().err
    lines = [line for line in error.splitlines() if line.startswith("gsbench: failed: ")]
    assert len(lines) == len(BAD)
    for mode, line in zip(BAD, lines, strict=True):
        assert BAD[mode] in line, (mode, line)
    assert len(list(tmp_path.glob("bad/*/*/*/results.json"))) == 1
    for failed in tmp_path.glob("bad/*/*/*/failed.json"):
        log = re.search(r"log: (\S+)$", read_json(failed)["message"])
        assert "observations 0" in Path(log[1]).read_text()


def test_a_program_that_hangs_is_ended_with_its_child(trainers, tmp_path, monkeypatch, capsys):
    """Both ignore SIGTERM."""
    monkeypatch.setenv("GSBENCH_RUNS", str(tmp_path))
    words = [*own(trainers), *COURTYARD, *HANG]
    assert run([*words, "densify.time_limit_minutes=0.25"]) == 1
    said = capsys.readouterr().err.splitlines()[-1]
    assert "python still ran after 15 s (densify.time_limit_minutes); its last lines: " in said
    pids = pids_in(Path(said.rpartition("log: ")[2]))
    assert len(pids) == 2
    assert not any(map(is_running, pids))


@pytest.fixture
def hanging(start, trainers, tmp_path):
    """gsbench with a trainer that hangs and ignores SIGTERM; ids of the trainer and its child."""
    process = start(*own(trainers), *COURTYARD, *HANG, new_group=True)
    pids = []
    deadline = time.monotonic() + 300
    while not pids and process.poll() is None and time.monotonic() < deadline:
        for log in (tmp_path / "runs/store/train").glob(".*/trainer.log"):
            pids = pids_in(log)
        time.sleep(0.05)
    yield process, pids
    process.kill()
    process.communicate()


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGKILL])
def test_another_program_ends_with_gsbench(hanging, signum):
    process, pids = hanging
    assert len(pids) == 2
    assert all(map(is_running, pids))
    os.kill(process.pid, signum)
    process.wait(60)
    wait_until(lambda: not any(map(is_running, pids)), 30)


@pytest.mark.parametrize(
    "words, said",
    [
        (["allow_targets=[]"], "if you trust it, add allow_targets=["),
        (["eval.at=[10]"], "shows its model only at the end"),
        (["train.max_seconds=10"], "cannot be stopped early"),
    ],
)
def test_bad_requests_are_refused_in_one_line(
    trainers, tmp_path, monkeypatch, refused, words, said
):
    monkeypatch.setenv("GSBENCH_RUNS", str(tmp_path))
    assert said in refused(*own(trainers), *COURTYARD, "densify=cloud", *words)
    assert not list(tmp_path.glob("store/train/*"))
