"""The MLflow mirror: what the files of a trial say, shown in a dashboard.

Files come first. A thread reads them and writes to MLflow in batches, so a tracker that is slow, down or read-only never
harms a trial; what it missed, ``mirror_trial`` adds later from the same files.
"""

from __future__ import annotations

import json
import logging
import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from filelock import FileLock

if TYPE_CHECKING:
    from mlflow import MlflowClient

log = logging.getLogger(__name__)

STATE = "mlflow.json"  # in the trial's folder: the run that mirrors it and how far
MAX_VALUE = 6000  # characters of a parameter (MLflow's limit)
MAX_PARAMS = 100  # parameters in a batch
MAX_METRICS = 1000  # metrics in a batch
SECONDS_TO_FINISH = 120.0  # patience with the tracker at the end of a trial
CURVES = {"metrics.jsonl": "train", "events.jsonl": "events"}


class Mirror:
    """Mirrors a trial while the ``with`` block runs; on leaving it, waits a bounded time for the tracker."""

    def __init__(self, options: dict[str, Any], runs: Path, folder: Path, values: dict[str, Any]) -> None:
        self.options, self.runs, self.folder, self.values = options, runs, folder, values
        self._ended = threading.Event()
        self._failed = False
        self._sources: list[Path] = [folder]
        self._thread = threading.Thread(target=self._run, name="mlflow-mirror", daemon=True)

    def follow(self, folder: Path) -> None:
        """Read curves from ``folder`` as well: where a training in progress writes them."""
        self._sources = [folder, self.folder]

    def __enter__(self) -> Mirror:
        if self.options["enabled"]:
            self._thread.start()
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        if not self.options["enabled"]:
            return
        self._failed = kind is not None
        self._ended.set()
        self._thread.join(SECONDS_TO_FINISH)
        if self._thread.is_alive():
            log.warning("tracking: MLflow is too slow; `gsbench sync` mirrors the rest of %s later", self.folder)

    def _run(self) -> None:
        try:
            run = TrackedTrial(self.options, self.runs, self.folder, self.values)
            while not self._ended.wait(self.options["flush_seconds"]):
                run.add_curves(self._sources)
            run.add_curves(self._sources)
            run.finish(failed=self._failed)
        except Exception as error:  # noqa: BLE001 - the mirror must never harm the trial, whatever the tracker raises
            log.warning("tracking: %s; the files are complete, `gsbench sync` mirrors them later", _one_line(error))
            log.debug("tracking failed", exc_info=True)


class TrackedTrial:
    """The MLflow run of one trial, opened anew or gone on with."""

    def __init__(self, options: dict[str, Any], runs: Path, folder: Path, values: dict[str, Any]) -> None:
        self.folder, self.values, self.images = folder, values, int(options["images"])
        self.client = connect(options["uri"], runs)
        self.state = _read_state(folder, self._uri())
        if "run_id" not in self.state:
            experiment = ensure_experiment(self.client, values["name"], runs)
            self.state = self._create_run(experiment)
            self._save()
        elif not self.state.get("complete"):
            self.client.update_run(self.state["run_id"], status="RUNNING")

    def add_curves(self, sources: list[Path]) -> None:
        """Log the records that were written since the last call."""
        if self.state.get("complete"):
            return
        from mlflow.entities import Metric

        now = int(time.time() * 1000)
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
                        Metric(f"{prefix}/{key}", float(value), now, record["step"])
                        for key, value in record.items()
                        if key != "step" and isinstance(value, (int, float))
                    ]
            for start in range(0, len(metrics), MAX_METRICS):
                self.client.log_batch(self.state["run_id"], metrics=metrics[start : start + MAX_METRICS])
            self.state["logged"][name] = newest
        self._save()

    def finish(self, failed: bool) -> None:
        """Log final metrics, pictures and tables from the trial's files, and close the run."""
        if self.state.get("complete"):
            return
        run_id = self.state["run_id"]
        results_path = self.folder / "results.json"
        if failed or not results_path.exists():
            self.client.set_terminated(run_id, "FAILED")
            return
        from mlflow.entities import Metric, RunTag

        results = json.loads(results_path.read_text())
        now = int(time.time() * 1000)
        numbers = dict(results["metrics"]) | {key: results[key] for key in ("num_gaussians", "num_init_points", "peak_memory_mb")}
        numbers |= {f"seconds_{key}": value for key, value in results["seconds"].items()}
        numbers |= {f"total/{key}": value for key, value in results["events"].items()}
        tags = {"protocol": results["protocol"], "raster": results["raster"]}
        tags |= {f"hash_{key}": value for key, value in results["hashes"].items()}
        self.client.log_batch(
            run_id,
            metrics=[Metric(key, float(value), now, 0) for key, value in numbers.items()],
            tags=[RunTag(key, value) for key, value in tags.items()],
        )
        for name in ("config.yaml", "results.json", "per_view.csv", "events.jsonl"):
            if (self.folder / name).exists():
                self.client.log_artifact(run_id, str(self.folder / name))
        for kind in ("renders", "ground_truth"):
            for picture in sorted((self.folder / kind).glob("*.png"))[: self.images]:
                self.client.log_artifact(run_id, str(picture), kind)
        self.client.set_terminated(run_id, "FINISHED")
        self.state["complete"] = True
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
        params = [Param(key, value[:MAX_VALUE]) for key, value in _flatten(values) if value]
        for start in range(0, len(params), MAX_PARAMS):
            self.client.log_batch(run_id, params=params[start : start + MAX_PARAMS], tags=[RunTag("gsbench", "1")])
        return {"run_id": run_id, "uri": self._uri(), "logged": {}, "complete": False}

    def _uri(self) -> str:
        return str(self.client.tracking_uri)

    def _save(self) -> None:
        path = self.folder / STATE
        temporary = path.with_name(f".{STATE}.tmp-{os.getpid()}")
        temporary.write_text(json.dumps(self.state))
        os.replace(temporary, path)


def default_uri(runs: Path) -> str:
    return f"sqlite:///{runs}/mlflow.db"


def connect(uri: str | None, runs: Path) -> MlflowClient:
    """A client of the tracker; creates a new SQLite database under a lock, since MLflow's own set-up races."""
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    logging.getLogger("alembic").setLevel(logging.WARNING)
    import mlflow

    client = mlflow.MlflowClient(tracking_uri=uri or default_uri(runs))
    with FileLock(runs / ".mlflow.lock"):
        client.search_experiments(max_results=1)  # the first call creates the tables
    return client


def prepare(options: dict[str, Any], runs: Path, experiment: str) -> None:
    """Create tables and ``experiment`` before many processes need them; a tracker that fails is only mentioned."""
    if not options["enabled"]:
        return
    try:
        ensure_experiment(connect(options["uri"], runs), experiment, runs)
    except Exception as error:  # noqa: BLE001 - the mirror must never harm a sweep, whatever the tracker raises
        log.warning("tracking: %s; the files will be complete, `gsbench sync` mirrors them later", _one_line(error))


def ensure_experiment(client: MlflowClient, name: str, runs: Path) -> str:
    """The id of experiment ``name``, created once under a lock."""
    with FileLock(runs / ".mlflow.lock"):
        found = client.get_experiment_by_name(name)
        if found is not None:
            return str(found.experiment_id)
        local = str(client.tracking_uri).startswith("sqlite:")
        location = (runs / "mlartifacts" / name).as_uri() if local else None
        return str(client.create_experiment(name, artifact_location=location))


def _read_state(folder: Path, uri: str) -> dict[str, Any]:
    """How far ``folder`` is mirrored at ``uri``; empty where it never was, or elsewhere, or was since computed anew."""
    try:
        state: dict[str, Any] = json.loads((folder / STATE).read_text())
    except (OSError, json.JSONDecodeError):
        return {}
    return state if state.get("uri") == uri and "run_id" in state else {}


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


def _one_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0][:200] if lines else ''}"
