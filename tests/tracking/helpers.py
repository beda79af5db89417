"""Trials as files, and what MLflow shows of them."""

import os
import socket
import sys
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from types import SimpleNamespace

from gsbench.runs.trial_folder import TrialFolder
from gsbench.system.locks import hold
from gsbench.tracking import Mirror
from gsbench.tracking.sync import mirror
from tests.helpers import read_json, write, write_lines
from tests.trials import STEPS, results_of, trial_values

ROOT = Path(__file__).resolve().parents[2]
STATE = "mlflow.json"  # in the trial's folder


def options(uri=None, patience=200.0):
    return {
        "enabled": True,
        "uri": uri,
        "flush_seconds": 0.2,
        "images": 2,
        "patience_seconds": patience,
    }


def begin_trial(values, uri=None, patience=200.0, **more):
    """The folder of a trial that has written its configuration, as the mirror finds it."""
    folder = TrialFolder.of(values).path
    write(folder / "config.yaml", values | {"tracking": options(uri, patience) | more})
    return folder


@contextmanager
def following(settings, folder):
    """Mirror the trial in ``folder``, which runs while the block does."""
    values = read_json(folder / "config.yaml") | {"tracking": settings}
    trial = SimpleNamespace(values=values, folder=folder, files=TrialFolder(folder))
    with Mirror([trial]), hold(folder / ".lock", "a trial"):
        write(folder / "config.yaml", values)
        yield


def mirror_trial(settings, folder, values, allowed=()):
    """Mirror an ended trial; False if nothing was missing. Raises any error of the tracker."""
    return mirror(TrialFolder(folder), settings, values, allowed)


def write_trial(folder, values, records=STEPS, psnr=20.0, **changes):
    """Write the files of a finished trial with that many records of its training."""
    seed, steps = values["seed"], range(1, records + 1)
    rows = [{"step": i, "loss": 1 / i, "l1": seed, "seconds": 0.01 * i} for i in steps]
    write_lines(folder / "metrics.jsonl", rows)
    write_lines(folder / "events.jsonl", [{"step": i, "cloned": i} for i in (50, 100)])
    if not (folder / "config.yaml").exists():
        begin_trial(values)
    gauge = {"scene_extent": 4.5, "scale_to_reference": None}
    results = results_of(
        values,
        metrics={"psnr": psnr},
        num_gaussians=10 + seed,
        iterations=records,
        seconds={"train": 2.0},
        events={"cloned": 150},
        hashes={"config": "abc", "data": sha256(values["scene"]["name"].encode()).hexdigest()},
        train_views=20,
        test_views=3,
        init_report={"num_points": 5, "pose_errors": None, "gauge": gauge},
    )
    write(folder / "results.json", results | changes)


def begun_trial(runs, seed=0, name="tracked", uri=None, patience=200.0, **more):
    """A trial that has begun, as (folder, configuration)."""
    values = trial_values(runs, seed, name)
    return begin_trial(values, uri, patience, **more), values


def ended_trial(runs, seed=0, name="tracked", uri=None, **more):
    """A finished trial, as (folder, configuration)."""
    folder, values = begun_trial(runs, seed, name, uri, **more)
    write_trial(folder, values)
    return folder, values


def found_runs(client, name):
    experiment = client.get_experiment_by_name(name)
    return [] if experiment is None else client.search_runs([experiment.experiment_id])


def trial_runs(client, name="tracked"):
    """The runs of an experiment's trials, without the parent runs of its ideas."""
    return [run for run in found_runs(client, name) if run.data.tags.get("kind") != "idea"]


def run_of(client, seed):
    """The only run of the experiment ``tracked`` with this seed."""
    (run,) = [run for run in trial_runs(client) if run.data.tags["seed"] == str(seed)]
    return run


def sync_trial(runs, uri, seed):
    """Send what the tracker lacks of the trial with this seed."""
    values = trial_values(runs, seed)
    mirror_trial(options(uri), TrialFolder.of(values).path, values)


def complete_runs(client, count):
    """The runs of ``count`` trials, each of which is complete and has each value once."""
    found = trial_runs(client)
    assert sorted(run.data.tags["seed"] for run in found) == [str(seed) for seed in range(count)]
    for run in found:
        assert run.info.status == "FINISHED"
        losses = [(i, 1 / i) for i in range(1, STEPS + 1)]
        assert history(client, run.info.run_id, "train/loss") == losses
        assert run.data.metrics["eval/gaussians"] == 10 + int(run.data.tags["seed"])
    return found


MIRROR = """
import sys
from pathlib import Path
from tests.tracking.helpers import begun_trial, following, options, write_trial
runs, uri, seed, patience = Path(sys.argv[1]), sys.argv[2] or None, int(sys.argv[3]), float(sys.argv[4])
folder, values = begun_trial(runs, seed, uri=uri, patience=patience)
with following(options(uri, patience), folder):
    write_trial(folder, values)
"""


def mirror_command(runs, uri, seed, patience=200.0):
    """The command of a process that writes and mirrors a trial."""
    return [sys.executable, "-c", MIRROR, str(runs), uri or "", str(seed), str(patience)]


def history(client, run_id, key):
    return [(metric.step, metric.value) for metric in client.get_metric_history(run_id, key)]


def free_port():
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        return int(server.getsockname()[1])


def child_environment():
    places = [str(ROOT), str(ROOT / "src"), os.environ.get("PYTHONPATH", "")]
    return dict(os.environ) | {"PYTHONPATH": os.pathsep.join(place for place in places if place)}
