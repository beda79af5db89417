"""The MLflow mirror: every metric arrives once and in the right experiment, and a bad tracker harms no trial."""

from __future__ import annotations

import json
import logging
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from gsbench import tracking
from gsbench.pipeline.trial_files import TrialPaths
from gsbench.tracking import Mirror, connect, ensure_experiment, mirror_trial, prepare

JOBS = 8
RECORDS = 150
CHILD = """
import json, sys
from tests.test_tracking import options, trial_values, write_trial
from gsbench.pipeline.trial_files import TrialPaths
from gsbench.tracking import Mirror
from pathlib import Path
runs, uri, seed = Path(sys.argv[1]), sys.argv[2] or None, int(sys.argv[3])
values = trial_values(runs, seed)
folder = TrialPaths.of(values).folder
with Mirror(options(uri), runs, folder, values):
    write_trial(folder, values)
"""


def options(uri: str | None = None) -> dict[str, Any]:
    return {"enabled": True, "uri": uri, "flush_seconds": 0.2, "images": 2}


def trial_values(runs: Path, seed: int = 0, name: str = "tracked") -> dict[str, Any]:
    named = {group: {"name": f"a_{group}"} for group in ("scene", "init", "densify")}
    return {"name": name, "seed": seed, "runs": str(runs), "train": {"iterations": RECORDS}, **named}


def write_trial(folder: Path, values: dict[str, Any], records: int = RECORDS, psnr: float = 20.0) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    seed = values["seed"]
    lines = [{"step": i, "loss": 1 / i, "seed": seed, "seconds": 0.01 * i} for i in range(1, records + 1)]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    (folder / "events.jsonl").write_text("".join(json.dumps({"step": i, "cloned": i}) + "\n" for i in (50, 100)))
    (folder / "config.yaml").write_text("a: 1\n")
    results = {
        "metrics": {"psnr": psnr},
        "num_gaussians": 10 + seed,
        "num_init_points": 5,
        "peak_memory_mb": 1.5,
        "iterations": records,
        "seconds": {"train": 2.0},
        "events": {"cloned": 150},
        "protocol": "paper-1",
        "raster": "cpu",
        "hashes": {"config": "abc"},
        "init_report": {
            "num_points": 5,
            "pose_errors": None,
            "gauge": {"scene_extent": 4.5, "scale_to_reference": None},
        },
    }
    (folder / "results.json").write_text(json.dumps(results))


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A runs folder with a database; creating one takes MLflow seconds."""
    folder = tmp_path_factory.mktemp("runs")
    prepare(options(), folder, "tracked")
    return folder


def found_runs(client: Any, name: str) -> list[Any]:
    experiment = client.get_experiment_by_name(name)
    return [] if experiment is None else client.search_runs([experiment.experiment_id])


def history(client: Any, run_id: str, key: str) -> list[tuple[int, float]]:
    return [(metric.step, metric.value) for metric in client.get_metric_history(run_id, key)]


def test_all_that_the_files_say_is_mirrored_once(runs: Path) -> None:
    values = trial_values(runs, seed=1)
    folder = TrialPaths.of(values).folder
    folder.mkdir(parents=True)
    with Mirror(options(), runs, folder, values):
        write_trial(folder, values)
    assert not mirror_trial(options(), runs, folder, values)
    client = connect(None, runs)
    (run,) = [run for run in found_runs(client, "tracked") if run.data.tags["seed"] == "1"]
    assert run.info.status == "FINISHED"
    assert run.data.metrics["psnr"] == 20.0
    assert run.data.metrics["total/cloned"] == 150
    assert {key: run.data.metrics[key] for key in run.data.metrics if key.startswith("init/")} == {
        "init/num_points": 5.0,
        "init/scene_extent": 4.5,
    }
    assert run.data.params["densify.name"] == "a_densify"
    assert history(client, run.info.run_id, "train/loss") == [(i, 1 / i) for i in range(1, RECORDS + 1)]
    assert history(client, run.info.run_id, "events/cloned") == [(50, 50.0), (100, 100.0)]
    assert {item.path for item in client.list_artifacts(run.info.run_id)} >= {"config.yaml", "results.json"}


def test_a_crash_between_sending_and_noting_it_repeats_nothing(runs: Path) -> None:
    values = trial_values(runs, seed=2)
    folder = TrialPaths.of(values).folder
    write_trial(folder, values)
    assert mirror_trial(options(), runs, folder, values)
    state = json.loads((folder / tracking.STATE).read_text())
    (folder / tracking.STATE).write_text(json.dumps(state | {"complete": None, "logged": {"metrics.jsonl": 70}}))
    assert mirror_trial(options(), runs, folder, values)
    client = connect(None, runs)
    (run,) = [run for run in found_runs(client, "tracked") if run.data.tags["seed"] == "2"]
    assert len(history(client, run.info.run_id, "train/loss")) == RECORDS
    assert len(history(client, run.info.run_id, "psnr")) == 1


def test_results_that_changed_replace_the_run(runs: Path) -> None:
    values = trial_values(runs, seed=3)
    folder = TrialPaths.of(values).folder
    write_trial(folder, values)
    assert mirror_trial(options(), runs, folder, values)
    write_trial(folder, values, psnr=33.0)
    assert mirror_trial(options(), runs, folder, values)
    assert not mirror_trial(options(), runs, folder, values)
    (run,) = [run for run in found_runs(connect(None, runs), "tracked") if run.data.tags["seed"] == "3"]
    assert run.data.metrics["psnr"] == 33.0


def test_a_failed_and_a_stopped_trial_say_so_and_are_gone_on_with(runs: Path) -> None:
    values = trial_values(runs, seed=4)
    folder = TrialPaths.of(values).folder
    folder.mkdir(parents=True)
    client = connect(None, runs)
    for error, status in ((KeyboardInterrupt(), "KILLED"), (RuntimeError("x"), "FAILED")):
        with pytest.raises(type(error)), Mirror(options(), runs, folder, values):  # noqa: PT012
            time.sleep(1)
            raise error
        (run,) = [run for run in found_runs(client, "tracked") if run.data.tags["seed"] == "4"]
        assert run.info.status == status
    with Mirror(options(), runs, folder, values):
        write_trial(folder, values)
    (run,) = [run for run in found_runs(client, "tracked") if run.data.tags["seed"] == "4"]
    assert run.info.status == "FINISHED"


def test_curves_of_a_training_in_progress_are_followed(runs: Path, tmp_path: Path) -> None:
    values = trial_values(runs, seed=5)
    folder = TrialPaths.of(values).folder
    folder.mkdir(parents=True)
    client = connect(None, runs)
    seen = 0
    with Mirror(options(), runs, folder, values) as mirror:
        mirror.follow(tmp_path)
        (tmp_path / "metrics.jsonl").write_text('{"step": 10, "loss": 0.5}\n{"step": 20, "lo')
        for _ in range(100):
            time.sleep(0.1)
            state = folder / tracking.STATE
            run_id = json.loads(state.read_text())["run_id"] if state.exists() else None
            seen = 0 if run_id is None else len(history(client, run_id, "train/loss"))
            if seen:
                break
    assert seen == 1


def free_port() -> int:
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        return int(server.getsockname()[1])


@pytest.mark.parametrize("uri", ["down", "not a database", "no such place", "nonsense"])
def test_a_broken_tracker_harms_no_trial(uri: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "broken.db").write_text("this is no database" * 100)
    address = {
        "down": f"http://127.0.0.1:{free_port()}",
        "not a database": f"sqlite:///{tmp_path}/broken.db",
        "no such place": "sqlite:////proc/no/such/place.db",
        "nonsense": "gopher://x",
    }[uri]
    values = trial_values(tmp_path)
    folder = TrialPaths.of(values).folder
    folder.mkdir(parents=True)
    prepare(options(address), tmp_path, "tracked")
    started = time.monotonic()
    with Mirror(options(address), tmp_path, folder, values):
        write_trial(folder, values)
    assert time.monotonic() - started < tracking.SECONDS_TO_FINISH + 5
    warnings = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert any(text.startswith("tracking: ") and "gsbench sync" in text for text in warnings)
    assert all("\n" not in text for text in warnings)
    assert (folder / "results.json").exists()


def test_a_slow_tracker_is_not_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(tracking, "SECONDS_TO_FINISH", 0.2)
    monkeypatch.setattr(tracking, "connect", lambda uri, runs: time.sleep(3))
    values = trial_values(tmp_path)
    folder = TrialPaths.of(values).folder
    folder.mkdir(parents=True)
    started = time.monotonic()
    with Mirror(options(), tmp_path, folder, values):
        write_trial(folder, values)
    assert time.monotonic() - started < 1.5
    assert "MLflow is slow" in caplog.text


def test_switched_off_means_no_mlflow(tmp_path: Path) -> None:
    code = (
        "import sys\nfrom pathlib import Path\nfrom gsbench.tracking import Mirror, prepare\n"
        "o = {'enabled': False, 'uri': None, 'flush_seconds': 1, 'images': 0}\n"
        "prepare(o, Path('.'), 'x')\nwith Mirror(o, Path('.'), Path('.'), {}): pass\nsys.exit('mlflow' in sys.modules)"
    )
    assert (
        subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=child_environment(), check=False).returncode == 0
    )


def child_environment() -> dict[str, str]:
    root = Path(__file__).resolve().parents[1]
    places = [str(root), str(root / "src"), os.environ.get("PYTHONPATH", "")]
    return dict(os.environ) | {"PYTHONPATH": os.pathsep.join(place for place in places if place)}


def run_jobs(runs: Path, uri: str | None) -> None:
    """Eight trials at once, in processes of their own, all new to the tracker."""
    command = [sys.executable, "-c", CHILD, str(runs), uri or ""]
    jobs = [
        subprocess.Popen(
            [*command, str(seed)], env=child_environment(), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        for seed in range(JOBS)
    ]
    outputs = [job.communicate(timeout=240)[0] for job in jobs]
    assert [job.returncode for job in jobs] == [0] * JOBS, outputs
    # A loaded machine may be too slow for the last words of some; sync is what makes up for that, and nothing else is.
    for seed in range(JOBS):
        values = trial_values(runs, seed)
        mirror_trial(options(uri), runs, TrialPaths.of(values).folder, values)


def check_jobs(client: Any) -> None:
    found = found_runs(client, "tracked")
    assert sorted(run.data.tags["seed"] for run in found) == [str(seed) for seed in range(JOBS)]
    for run in found:
        seed = int(run.data.tags["seed"])
        assert run.info.status == "FINISHED"
        assert history(client, run.info.run_id, "train/loss") == [(i, 1 / i) for i in range(1, RECORDS + 1)]
        assert {value for _, value in history(client, run.info.run_id, "train/seed")} == {float(seed)}
        assert run.data.metrics["num_gaussians"] == 10 + seed
    assert found_runs(client, "Default") == []


@pytest.mark.end_to_end
def test_eight_jobs_at_once_on_a_new_sqlite_database(tmp_path: Path) -> None:
    run_jobs(tmp_path, None)
    check_jobs(connect(None, tmp_path))


@pytest.fixture
def postgresql(tmp_path: Path) -> Iterator[str]:
    """The address of an empty database in a PostgreSQL server of our own; the test is skipped where there is none."""
    pytest.importorskip("psycopg2", reason="needs psycopg2-binary")
    homes = (
        sorted(Path("/usr/lib/postgresql").glob("*/bin"), key=lambda path: int(path.parent.name))
        if os.name == "posix"
        else []
    )
    binaries = [str(path) for path in homes] + os.environ.get("PATH", "").split(os.pathsep)
    initdb = shutil.which("initdb", path=os.pathsep.join(reversed(binaries[: len(homes)])) or None) or shutil.which(
        "initdb"
    )
    if initdb is None:
        pytest.skip("needs a PostgreSQL server (apt-get install postgresql)")
    home = Path(initdb).parent
    data = tmp_path / "postgresql"
    data.mkdir()
    prefix = []
    if os.geteuid() == 0:  # the server refuses to run as root
        if shutil.which("runuser") is None:
            pytest.skip("PostgreSQL does not run as root, and there is no runuser")
        prefix = ["runuser", "-u", "nobody", "--"]
        shutil.chown(data, "nobody")
        for folder in (tmp_path, *tmp_path.parents[:2]):
            folder.chmod(folder.stat().st_mode | 0o011)
    port = free_port()
    run = lambda *words: subprocess.run([*prefix, *words], check=True, capture_output=True, timeout=60)  # noqa: E731
    run(str(home / "initdb"), "-D", str(data), "-U", "gsbench", "--auth=trust", "--no-sync")
    settings = f"-p {port} -c listen_addresses=127.0.0.1 -c unix_socket_directories={data} -c fsync=off"
    run(str(home / "pg_ctl"), "-D", str(data), "-l", str(data / "log"), "-w", "-o", settings, "start")
    yield f"postgresql+psycopg2://gsbench@127.0.0.1:{port}/postgres"
    subprocess.run([*prefix, str(home / "pg_ctl"), "-D", str(data), "-m", "immediate", "stop"], check=False, timeout=60)


@pytest.mark.end_to_end
def test_eight_jobs_at_once_on_a_new_postgresql_database(tmp_path: Path, postgresql: str) -> None:
    run_jobs(tmp_path, postgresql)
    check_jobs(connect(postgresql, tmp_path))


@pytest.mark.end_to_end
def test_machines_that_share_no_folder_create_one_experiment(tmp_path: Path, postgresql: str) -> None:
    """No file lock is shared: the database itself has to keep them apart."""
    code = (
        "import sys\nfrom pathlib import Path\nfrom gsbench.tracking import connect, ensure_experiment\n"
        "runs = Path(sys.argv[2]); runs.mkdir()\nprint(ensure_experiment(connect(sys.argv[1], runs), 'shared', runs))"
    )
    jobs = [
        subprocess.Popen(
            [sys.executable, "-c", code, postgresql, str(tmp_path / f"machine{i}")],
            env=child_environment(),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for i in range(4)
    ]
    outputs = [job.communicate(timeout=240) for job in jobs]
    assert [job.returncode for job in jobs] == [0] * 4, [error[-500:] for _, error in outputs]
    assert len({out.strip().splitlines()[-1] for out, _ in outputs}) == 1


def test_deleted_experiment_is_restored(runs: Path) -> None:
    client = connect(None, runs)
    first = ensure_experiment(client, "gone", runs)
    client.delete_experiment(first)
    assert ensure_experiment(client, "gone", runs) == first
    assert client.get_experiment(first).lifecycle_stage == "active"
