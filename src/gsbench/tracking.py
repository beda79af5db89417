"""The MLflow mirror: what the files of a trial say, shown in a dashboard.

Files come first. A thread reads them and writes to MLflow in batches, so a tracker that is slow, down or read-only
never harms a trial; what it missed, `mirror_trial` adds later from the same files. Each metric's time is a function of
the files, so that MLflow, which drops exact repetitions, holds it once even if it was sent twice.
"""

from __future__ import annotations

import json
import logging
import os
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from filelock import FileLock

from gsbench.config import sha256_of
from gsbench.files import write_json
from gsbench.pipeline.locks import BusyError, hold
from gsbench.pipeline.trial_files import FAILED, RESULTS, read_object

if TYPE_CHECKING:
    from mlflow import MlflowClient

log = logging.getLogger(__name__)

STATE = "mlflow.json"  # in the trial's folder: the run that mirrors it and how far
LOCK = ".mlflow.lock"
MAX_VALUE = 6000  # characters of a parameter (MLflow's limit)
MAX_PARAMS = 100  # parameters in a batch
MAX_METRICS = 1000  # metrics in a batch
SECONDS_TO_FINISH = 30.0  # patience with the tracker at the end of a trial
SECONDS_TO_STOP = 3.0  # and when a signal asks to end
ADVISORY_LOCK = 0x67736265_6E6368  # "gsbench": the number of our lock in a PostgreSQL database
# Of the init's report: is the cloud to be trusted, and what does a volume threshold mean there?
INIT_FIELDS = ("num_registered", "num_points", "mean_reprojection_error", "mean_track_length", "pose_errors", "gauge")
CURVES = {"metrics.jsonl": "train", "events.jsonl": "events"}
# What would print, phone home or hang for minutes in a thread beside a training.
SETTINGS = {
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "MLFLOW_LOGGING_LEVEL": "WARNING",
    "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "2",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "20",
}


class Mirror:
    """Mirrors a trial while the ``with`` block runs; on leaving it, waits a bounded time for the tracker."""

    def __init__(self, options: dict[str, Any], runs: Path, folder: Path, values: dict[str, Any]) -> None:
        self.options, self.runs, self.folder, self.values = options, runs, folder, values
        self._ended = threading.Event()
        self._status = "FINISHED"
        self._sources: list[Path] = [folder]
        self._thread = threading.Thread(target=self._run, name="mlflow-mirror", daemon=True)

    def follow(self, folder: Path) -> None:
        """Read curves from ``folder`` as well: where a training in progress writes them."""
        self._sources = [folder, self.folder]

    def __enter__(self) -> Mirror:
        if self.options["enabled"]:
            self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: object) -> None:
        if not self.options["enabled"]:
            return
        stopped = kind is not None and not issubclass(kind, Exception)
        if kind is not None:
            self._status = "KILLED" if stopped else "FAILED"
        self._ended.set()
        self._thread.join(SECONDS_TO_STOP if stopped else SECONDS_TO_FINISH)
        if self._thread.is_alive():
            log.warning("tracking: MLflow is slow; `gsbench sync` mirrors the rest of %s later", self.folder)

    def _run(self) -> None:
        try:
            with hold(self.folder / LOCK, "mirroring", wait=False):
                run = TrackedTrial(self.options, self.runs, self.folder, self.values)
                while not self._ended.wait(self.options["flush_seconds"]):
                    run.add_curves(self._sources)
                run.add_curves(self._sources)
                run.finish(self._status)
        except BusyError:
            log.debug("another process mirrors %s", self.folder)
        except Exception as error:  # the mirror must never harm the trial, whatever the tracker raises
            log.warning("tracking: %s; the files are complete, `gsbench sync` mirrors them later", _one_line(error))
            log.debug("tracking failed", exc_info=True)


def mirror_trial(options: dict[str, Any], runs: Path, folder: Path, values: dict[str, Any]) -> bool:
    """Mirror what is missing of an ended trial; False if nothing was missing. Raises what the tracker raises."""
    with hold(folder / LOCK, "mirroring", wait=False):
        run = TrackedTrial(options, runs, folder, values)
        if run.is_complete:
            return False
        run.add_curves([folder])
        run.finish("FAILED" if (folder / FAILED).exists() else "FINISHED")
    return True


class TrackedTrial:
    """The MLflow run of one trial, opened anew or gone on with."""

    def __init__(self, options: dict[str, Any], runs: Path, folder: Path, values: dict[str, Any]) -> None:
        self.folder, self.values, self.images = folder, values, int(options["images"])
        self.client = connect(options["uri"], runs)
        self.state = self._known_state()
        if not self.state:
            experiment = ensure_experiment(self.client, values["name"], runs)
            self.state = self._create_run(experiment)
            self._save()
        elif not self.is_complete:
            self.client.update_run(self.state["run_id"], status="RUNNING")

    @property
    def is_complete(self) -> bool:
        """Whether the run shows the present results."""
        return self.state.get("complete") is not None and self.state["complete"] == self._results_hash()

    def _known_state(self) -> dict[str, Any]:
        """How far the trial is mirrored here; empty where it never was, was elsewhere, or was since computed anew."""
        from mlflow.exceptions import MlflowException

        state = read_object(self.folder / STATE)
        if state.get("uri") != self._uri() or "run_id" not in state:
            return {}
        try:
            run = self.client.get_run(state["run_id"])
        except MlflowException as error:
            if error.error_code != "RESOURCE_DOES_NOT_EXIST":
                raise
            return {}
        if run.info.lifecycle_stage != "active":
            return {}
        if state.get("complete") not in (None, self._results_hash()) and self._results_hash() is not None:
            self.client.delete_run(state["run_id"])  # it shows results that are no longer the trial's
            return {}
        return state

    def _results_hash(self) -> str | None:
        results = read_object(self.folder / RESULTS)
        return sha256_of(results) if results else None

    def add_curves(self, sources: list[Path]) -> None:
        """Log the records that were written since the last call."""
        if self.is_complete:
            return
        from mlflow.entities import Metric

        for name, prefix in CURVES.items():
            source = next((folder / name for folder in sources if (folder / name).exists()), None)
            if source is None:
                continue
            last = self.state["logged"].get(name, 0)
            metrics, newest = [], last
            for record in _records(source):
                if record["step"] > last:
                    newest = record["step"]
                    metrics += [
                        Metric(f"{prefix}/{key}", float(value), self._time_of(record), record["step"])
                        for key, value in record.items()
                        if key != "step" and isinstance(value, (int, float))
                    ]
            for start in range(0, len(metrics), MAX_METRICS):
                self.client.log_batch(self.state["run_id"], metrics=metrics[start : start + MAX_METRICS])
            self.state["logged"][name] = newest
        self._save()

    def finish(self, status: str) -> None:
        """Log final metrics, pictures and tables from the trial's files, and close the run with MLflow's ``status``."""
        if self.is_complete:
            return
        run_id = self.state["run_id"]
        results = read_object(self.folder / RESULTS)
        if status != "FINISHED" or not results:
            self.client.set_terminated(run_id, "FAILED" if status == "FINISHED" else status)
            return
        from mlflow.entities import Metric, RunTag

        ended = self._time_of({"step": results["iterations"], "seconds": results["seconds"]["train"]})
        numbers = dict(results["metrics"]) | {
            key: results[key] for key in ("num_gaussians", "num_init_points", "peak_memory_mb")
        }
        numbers |= {f"seconds_{key}": value for key, value in results["seconds"].items()}
        numbers |= {f"total/{key}": value for key, value in results["events"].items()}
        numbers |= {f"init/{key}": value for key, value in _numbers(results.get("init_report", {}), INIT_FIELDS)}
        tags = {"protocol": results["protocol"], "raster": results["raster"]}
        tags |= {f"hash_{key}": value for key, value in results["hashes"].items()}
        self.client.log_batch(
            run_id,
            metrics=[Metric(key, float(value), ended, 0) for key, value in numbers.items()],
            tags=[RunTag(key, value) for key, value in tags.items()],
        )
        for name in ("config.yaml", "results.json", "init_report.json", "per_view.csv", "events.jsonl"):
            if (self.folder / name).exists():
                self.client.log_artifact(run_id, str(self.folder / name))
        for kind in ("figures", "renders", "ground_truth"):
            for picture in sorted((self.folder / kind).glob("*.png"))[: self.images]:
                self.client.log_artifact(run_id, str(picture), kind)
        self.client.set_terminated(run_id, "FINISHED")
        self.state["complete"] = self._results_hash()
        self._save()

    def _create_run(self, experiment_id: str) -> dict[str, Any]:
        from mlflow.entities import Param, RunTag

        values = self.values
        label = f"{values['scene']['name']} {values['init']['name']}-{values['densify']['name']} seed {values['seed']}"
        tags = {
            "mlflow.runName": label,
            "kind": "trial",
            "scene": values["scene"]["name"],
            "init": values["init"]["name"],
            "densify": values["densify"]["name"],
            "seed": str(values["seed"]),
            "folder": str(self.folder),
        }
        run_id = self.client.create_run(experiment_id, tags=tags, run_name=label).info.run_id
        params = [Param("arm", f"{values['init']['name']}-{values['densify']['name']}")]  # first in MLflow's charts
        params += [Param(key, value[:MAX_VALUE]) for key, value in _flatten(values) if value]
        for start in range(0, len(params), MAX_PARAMS):
            self.client.log_batch(run_id, params=params[start : start + MAX_PARAMS], tags=[RunTag("gsbench", "1")])
        return {
            "run_id": run_id,
            "uri": self._uri(),
            "started": int(time.time() * 1000),
            "logged": {},
            "complete": None,
        }

    def _time_of(self, record: dict[str, Any]) -> int:
        """A record's time in ms: the run's start, and the training time or else the iterations since."""
        return int(self.state["started"] + 1000 * float(record.get("seconds", record["step"] / 1000)))

    def _uri(self) -> str:
        return str(self.client.tracking_uri)

    def _save(self) -> None:
        write_json(self.folder / STATE, self.state)


def default_uri(runs: Path) -> str:
    return f"sqlite:///{runs}/mlflow.db"


def connect(uri: str | None, runs: Path) -> MlflowClient:
    """A client of the tracker; creates a new database under a lock, since MLflow's own set-up races."""
    for name, value in SETTINGS.items():
        os.environ.setdefault(name, value)
    import mlflow

    for logger in ("mlflow", "alembic"):  # importing mlflow has set their levels
        logging.getLogger(logger).setLevel(logging.WARNING)
    address = uri or default_uri(runs)
    with _set_up_lock(address, runs):
        client = mlflow.MlflowClient(tracking_uri=address)  # with the first client come the tables
        client.search_experiments(max_results=1)
    return client


@contextmanager
def _set_up_lock(uri: str, runs: Path) -> Iterator[None]:
    """Let one process at a time create tables and experiments: on this runs folder, and on a PostgreSQL everywhere."""
    with FileLock(runs / ".mlflow.lock"):
        if not uri.startswith("postgresql"):
            yield
            return
        import sqlalchemy

        engine = sqlalchemy.create_engine(uri, poolclass=sqlalchemy.pool.NullPool)
        with engine.connect() as connection:  # closing it frees the lock, as does the death of this process
            connection.execute(sqlalchemy.text("SELECT pg_advisory_lock(:key)"), {"key": ADVISORY_LOCK})
            yield


def prepare(options: dict[str, Any], runs: Path, experiment: str) -> None:
    """Create tables and ``experiment`` before many processes need them; a tracker that fails is only mentioned."""
    if not options["enabled"]:
        return
    try:
        ensure_experiment(connect(options["uri"], runs), experiment, runs)
    except Exception as error:  # noqa: BLE001 - the mirror must never harm a sweep, whatever the tracker raises
        log.warning("tracking: %s; the files will be complete, `gsbench sync` mirrors them later", _one_line(error))


def ensure_experiment(client: MlflowClient, name: str, runs: Path) -> str:
    """The id of experiment ``name``, created once under a lock; a deleted one is restored."""
    from mlflow.exceptions import MlflowException

    with _set_up_lock(str(client.tracking_uri), runs):
        found = client.get_experiment_by_name(name)
        if found is None:
            served = str(client.tracking_uri).startswith(("http:", "https:"))  # then the server says where
            location = None if served else (runs / "mlartifacts" / name).as_uri()
            with suppress(MlflowException):  # a rival on another machine was first, or what follows says what is wrong
                return str(client.create_experiment(name, artifact_location=location))
            found = client.get_experiment_by_name(name)
        if found is None:
            raise RuntimeError(f"MLflow could not create the experiment {name}")
        if found.lifecycle_stage != "active":
            client.restore_experiment(found.experiment_id)
        return str(found.experiment_id)


def _records(path: Path) -> Iterator[dict[str, Any]]:
    for line in path.read_text().splitlines():
        try:
            yield json.loads(line)
        except json.JSONDecodeError:  # the last line, still being written
            return


def _flatten(values: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    for key, value in values.items():
        if isinstance(value, dict):
            yield from _flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", str(value)


def _numbers(report: dict[str, Any], names: Sequence[str]) -> Iterator[tuple[str, float]]:
    """The numbers among the fields ``names`` of a report, nested ones included; what is unknown is left out."""
    for name in names:
        value = report.get(name)
        if isinstance(value, dict):
            yield from _numbers(value, tuple(value))
        elif isinstance(value, (int, float)) and not isinstance(value, bool):
            yield name, float(value)


def _one_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0][:200] if lines else ''}"
