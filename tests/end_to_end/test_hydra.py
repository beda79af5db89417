"""gsbench as a Hydra app, through the real program: other launchers, and callbacks."""

from importlib.util import find_spec
from shlex import split

import pytest

from tests.helpers import read_json, write

pytestmark = pytest.mark.slow
SECONDS = 900  # a limit for a trial of three iterations on a busy machine

TINY = split(
    "scene=courtyard scene.views=6 scene.width=64 scene.height=48 init=random init.count=300 "
    "densify=none train.iterations=3 raster=reference device=cpu threads=1 tracking=none "
    "eval.download=false eval.lpips=[]"
)
CALLBACK = """
from hydra.experimental.callback import Callback

class Note(Callback):
    def __init__(self, path):
        self.path = path

    def note(self, text):
        with open(self.path, "a") as stream:
            stream.write(text + "\\n")

    def on_multirun_start(self, config, **rest):
        self.note("sweep begins")

    def on_job_start(self, config, **rest):
        self.note(f"{config.hydra.job.num} begins with seed {config.seed}")

    def on_job_end(self, config, job_return, **rest):
        self.note(f"{config.hydra.job.num} ends {job_return.status.name}")

    def on_multirun_end(self, config, **rest):
        self.note("sweep ends")
"""
EXPERIMENT = """# @package _global_
name: own-${densify.name}
hydra:
  mode: MULTIRUN
  callbacks:
    note:
      _target_: notes.Note
      path: notes.txt
  sweeper:
    params:
      seed: 0,1
"""


def results_below(folder):
    return [read_json(path) for path in sorted(folder.rglob("results.json"))]


def test_an_experiment_file_can_set_callbacks_and_a_sweep(gsbench, tmp_path):
    write(tmp_path / "conf/experiment/own.yaml", EXPERIMENT)
    (tmp_path / "notes.py").write_text(CALLBACK)
    words = [
        "--config-dir",
        "conf",
        "+experiment=own",
        *TINY,
        "hydra/launcher=basic",
        "allow_targets=[notes]",
    ]
    listed = gsbench(*words, "--dry-run")
    assert "2 trials: 2 missing" in listed.stdout, listed.stderr
    assert not (tmp_path / "notes.txt").exists()  # where nothing runs, no callback is called

    gsbench(*words)
    results = results_below(tmp_path / "runs/own-none")
    assert [result["seed"] for result in results] == [0, 1]
    notes = (tmp_path / "notes.txt").read_text().splitlines()
    assert (notes[0], notes[-1]) == ("sweep begins", "sweep ends")
    ends = [f"{i} ends COMPLETED" for i in (0, 1)]
    assert sorted(notes[1:-1]) == sorted([*(f"{i} begins with seed {i}" for i in (0, 1)), *ends])


@pytest.mark.parametrize(
    "package, launcher",
    [("hydra_joblib_launcher", "joblib"), ("hydra_submitit_launcher", "submitit_local")],
)
def test_another_launcher_runs_each_trial_as_a_job(gsbench, tmp_path, package, launcher):
    if find_spec(f"hydra_plugins.{package}") is None:
        pytest.skip(f"needs {package.replace('_', '-')} (group dev)")
    words = ["-m", *TINY, f"hydra/launcher={launcher}", "name=x", "seed=0,1"]
    gsbench(*words)
    results = sorted((tmp_path / "runs/x").rglob("results.json"))
    assert len(results) == 2
    assert "2 trials: 2 done" in gsbench("status x").stdout
    written = [path.stat().st_mtime_ns for path in results]
    gsbench(*words)
    assert [path.stat().st_mtime_ns for path in results] == written  # nothing is done twice
    # What the launcher unpickles never lies where a stranger's runs folder could have it already.
    places = {path.parts[-4] for path in (tmp_path / "runs/.hydra").rglob("*_result.pkl")}
    assert len(places) == 2 * (launcher == "submitit_local")
    assert all(len(place) == 16 for place in places)


@pytest.mark.parametrize(
    "name, sweeper",
    [
        (".hydra", "gsbench"),
        (".hydra/multirun.yaml", "gsbench"),
        (".hydra/0/.hydra/config.yaml", "gsbench"),
        (".hydra/0/.hydra/config.yaml", "basic"),
    ],
)
def test_hydra_writes_through_no_link_of_a_strangers_runs_folder(gsbench, tmp_path, name, sweeper):
    precious = tmp_path / "precious"
    precious.mkdir() if name == ".hydra" else precious.write_text("mine")
    link = tmp_path / f"runs/{name}"
    link.parent.mkdir(parents=True)
    link.symlink_to(precious)
    words = ["-m", *TINY, "name=x", "seed=0,1", "hydra.output_subdir=.hydra"]
    done = gsbench(*words, f"hydra/sweeper={sweeper}", code=2)
    assert f"{link} is a link" in done.stderr
    assert not list(precious.iterdir()) if precious.is_dir() else precious.read_text() == "mine"


def test_a_failed_trial_of_another_launcher_is_one_line_and_exit_code_1(gsbench, tmp_path):
    (tmp_path / "own.py").write_text(
        "from gsbench.densify import NoDensifier\nclass Own(NoDensifier):\n    def observe(self, "
        "*rest, **named):\n        raise RuntimeError('no luck')\n"
    )
    words = [
        "-m",
        *TINY,
        *split("hydra/launcher=basic name=x seed=0,1 densify._target_=own.Own allow_targets=[own]"),
    ]
    done = gsbench(*words, code=1)
    assert "Traceback" not in done.stderr
    failed = [line for line in done.stderr.splitlines() if line.startswith("gsbench: failed")]
    assert len(failed) == 2
    assert "2 trials: 2 failed" in gsbench("status x", code=1).stdout
