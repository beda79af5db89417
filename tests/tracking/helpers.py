"""Trials as files, and what MLflow shows of them."""

import json
import os
import socket
import sys
from contextlib import contextmanager
from pathlib import Path

from gsbench.runs.trial_folder import TrialFolder
from gsbench.system.locks import hold
from gsbench.tracking import Mirror
from gsbench.tracking.tracker_run import mirror_ended

ROOT = Path(__file__).resolve().parents[2]
RECORDS = 150
STATE = "mlflow.json"  # in the trial's folder


def options(uri=None, patience=30.0):
    return {
        "enabled": True,
        "uri": uri,
        "flush_seconds": 0.2,
        "images": 2,
        "patience_seconds": patience,
    }


def trial_values(runs, seed=0, name="tracked"):
    named = {group: {"name": f"a_{group}"} for group in ("scene", "init", "densify")}
    return {
        "name": name,
        "seed": seed,
        "runs": str(runs),
        "train": {"iterations": RECORDS},
        **named,
    }


def begin_trial(values, uri=None, patience=30.0, **more):
    """The folder of a trial that has written its configuration, as the mirror finds it."""
    folder = TrialFolder.of(values).path
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.yaml").write_text(
        json.dumps(values | {"tracking": options(uri, patience) | more})
    )
    return folder


@contextmanager
def following(settings, folder):
    """Mirror the trial in ``folder``, which runs while the block does."""
    with Mirror() as mirror, hold(folder / ".lock", "a trial"):
        mirror.follow(folder, settings)
        yield


def mirror_trial(settings, folder, values, allowed=()):
    """Mirror an ended trial; False if nothing was missing. Raises any error of the tracker."""
    return mirror_ended(TrialFolder(folder), settings, values, allowed)


def write_trial(folder, values, records=RECORDS, psnr=20.0):
    folder.mkdir(parents=True, exist_ok=True)
    seed = values["seed"]
    lines = [
        {"step": i, "loss": 1 / i, "l1": seed, "seconds": 0.01 * i} for i in range(1, records + 1)
    ]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    (folder / "events.jsonl").write_text(
        "".join(json.dumps({"step": i, "cloned": i}) + "\n" for i in (50, 100))
    )
    if not (folder / "config.yaml").exists():
        begin_trial(values)
    results = {
        "status": "complete",
        "experiment": values["name"],
        **{group: values[group]["name"] for group in ("scene", "init", "densify")},
        "seed": seed,
        "unavailable": {},
        "versions": {},
        "metrics": {"psnr": psnr},
        "num_gaussians": 10 + seed,
        "num_init_points": 5,
        "peak_memory_mb": 1.5,
        "iterations": records,
        "seconds": {"train": 2.0},
        "events": {"cloned": 150},
        "protocol": "paper-1",
        "raster": "cpu",
        "hashes": {"config": "abc", "data": "0123456789abcdef" * 4},
        "train_views": 20,
        "test_views": 3,
        "init_report": {
            "num_points": 5,
            "pose_errors": None,
            "gauge": {"scene_extent": 4.5, "scale_to_reference": None},
        },
    }
    (folder / "results.json").write_text(json.dumps(results))


def found_runs(client, name):
    experiment = client.get_experiment_by_name(name)
    return [] if experiment is None else client.search_runs([experiment.experiment_id])


def run_of(client, seed):
    """The only run of the experiment ``tracked`` with this seed."""
    (run,) = [run for run in found_runs(client, "tracked") if run.data.tags["seed"] == str(seed)]
    return run


MIRROR = """
import sys
from pathlib import Path
from tests.tracking.helpers import begin_trial, following, options, trial_values, write_trial
runs, uri, seed, patience = Path(sys.argv[1]), sys.argv[2] or None, int(sys.argv[3]), float(sys.argv[4])
values = trial_values(runs, seed)
folder = begin_trial(values, uri, patience)
with following(options(uri, patience), folder):
    write_trial(folder, values)
"""


def mirror_command(runs, uri, seed, patience=30.0):
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
