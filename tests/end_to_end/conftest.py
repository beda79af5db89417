"""Run the real program as a user does: in a subprocess, in an empty folder."""

import os
import shutil
import subprocess
import sys
from functools import partial
from shlex import split

import pytest
from filelock import FileLock

from gsbench.cli import run
from gsbench.files import file_sha256
from gsbench.init import Sfm
from gsbench.init.base import MODEL_FOLDER
from gsbench.scene.courtyard.render import render_courtyard
from tests.helpers import read_json, words_of
from tests.processes import completed, heed_interrupts
from tests.scene.captures import read_colmap

# A whole trial in seconds: a small courtyard, its exact cameras, a random cloud, few iterations,
# nothing downloaded.
SMALL = split(
    "scene=courtyard scene.views=12 scene.width=96 scene.height=72 init=random "
    "init.count=3000 init.size=1.2 train.iterations=300 train.position_steps=300 "
    "train.densify_start=50 train.densify_interval=50 train.densify_stop=250 "
    "train.opacity_reset_interval=1000 train.checkpoint_every=40 eval.download=false "
    "eval.lpips=[squeeze]"
)
FINISHED = "finished"  # the name of the experiment that all tests may copy

FINISHED_SWEEP = ["-m", *SMALL, f"name={FINISHED}", *split("densify=adc,volumetric seed=0,1")]
FINISHED_SWEEP.append("tracking=none")


def common_folder(tmp_path_factory):
    """The temporary folder of this run of the tests, which is the same for all of its workers."""
    base = tmp_path_factory.getbasetemp()
    return base.parent if "PYTEST_XDIST_WORKER" in os.environ else base


@pytest.fixture(scope="session")
def finished_runs(environment, tmp_path_factory):
    """A runs folder with an experiment of four trials, trained once for all workers of the tests.

    Tests must not change it.
    """
    runs = common_folder(tmp_path_factory) / "finished-runs"
    with FileLock(f"{runs}.lock"):
        if not (runs / "complete").exists():
            program(environment, runs, *FINISHED_SWEEP)
            (runs / "complete").touch()
    return runs


# The finished experiment's trials of seed 0, for tests that disturb them.
SWEEP = ["-m", *SMALL, "name=attacked", "densify=adc,volumetric", "tracking=none"]


@pytest.fixture
def runs(finished_runs, tmp_path):
    """A copy of the finished experiment's runs folder, with its scene and initial cloud."""
    return shutil.copytree(finished_runs, tmp_path / "runs", symlinks=True)


@pytest.fixture(scope="session")
def environment(tmp_path_factory):
    """The environment of the program: its own runs folder, no weights, no settings of the user."""
    kept = {
        key: value
        for key, value in os.environ.items()
        if not key.startswith(("GSBENCH_", "MLFLOW_"))
    }
    return kept | {
        "GSBENCH_RUNS": str(tmp_path_factory.mktemp("runs")),
        "TORCH_HOME": str(common_folder(tmp_path_factory) / "hub"),  # its name is in results
    }


def program(environment, runs, *arguments, code=0, timeout=900, cwd=None, **changes):
    """Call ``gsbench`` with arguments, as `completed`; words in capitals are of its environment.

    The time limit is for a busy machine.
    """
    command = [sys.executable, "-m", "gsbench.cli", *words_of(*arguments)]
    own = environment | {"GSBENCH_RUNS": str(runs)} | changes
    return completed(command, code, cwd=cwd, env=own, timeout=timeout)


@pytest.fixture
def gsbench(environment, tmp_path):
    """Call `program` in the folder of the test, with the runs folder there."""
    return partial(program, environment, tmp_path / "runs", cwd=tmp_path)


def trial_of(settings, runs, capture, *words):
    """Run one trial of the capture in a folder within this process; returns the trial's folder."""
    place = [f"scene.path={capture}", f"runs={runs}", f"name={capture.name}"]
    assert run([*settings, *place, *words]) == 0
    (folder,) = {path.parent for path in (runs / capture.name).glob("*/*/*/results.json")}
    return folder


def render_with_points(folder, views):
    """Write a COLMAP folder of the courtyard, with the points that structure from motion finds."""
    render_courtyard(folder, views, width=192, height=144)
    sfm = Sfm(threads=1, first_octave=0, max_num_features=1500, two_view_tracks=True)
    sfm.run(read_colmap(folder), folder.with_name("sfm"))
    shutil.rmtree(folder / "sparse")
    shutil.copytree(folder.with_name("sfm") / MODEL_FOLDER, folder / "sparse/0")


# Keys that differ between two runs of the same trial: times, and the places and times of its input
# files.
CLOCKED = ("seconds", "peak_memory_mb", "measured", "made_of")


@pytest.fixture
def start(environment, tmp_path):
    """Start ``gsbench`` in the runs folder of the test; words in capitals are of its environment.

    With ``new_group``, it and all that it starts are a group, which can be sent Ctrl-C as by a
    terminal.
    """
    own = environment | {"GSBENCH_RUNS": str(tmp_path / "runs")}

    def run(*arguments, new_group=False, **changes):
        return subprocess.Popen(
            [sys.executable, "-m", "gsbench.cli", *arguments],
            cwd=tmp_path,
            env=own | changes,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=new_group,
            preexec_fn=heed_interrupts if new_group else None,
        )

    return run


def checksums(trial, names, *folders):
    """The checksums of files of a trial, and of all that lie in ``folders`` of it."""
    files = [trial / name for name in names]
    files += [file for folder in folders for file in (trial / folder).iterdir()]
    return {file.relative_to(trial): file_sha256(file) for file in files}


def results_of(runs, name):
    """The results of a sweep without times, with checksums of models, pictures and tables."""
    found = {}
    for path in sorted(runs.glob(f"{name}/*/*/*/results.json")):
        results = {key: value for key, value in read_json(path).items() if key not in CLOCKED}
        results["init_report"].pop("seconds", None)
        for of_the_sweep in ("experiment", "questions"):
            results.pop(of_the_sweep, None)
        names = split("point_cloud.ply per_view.csv events.jsonl")
        results["files"] = checksums(path.parent, names, "renders")
        found[f"{path.parent.parent.name}/{path.parent.name}"] = results
    return found


@pytest.fixture
def undisturbed(finished_runs):
    """The results of the trials of ``SWEEP`` from an undisturbed run."""
    return {
        trial: found
        for trial, found in results_of(finished_runs, FINISHED).items()
        if trial.endswith("seed0")
    }
