"""A trial as a run of MLflow.

Each metric's time is a function of the files, so that MLflow, which drops exact repetitions, holds it once even if it
was sent twice. Which run it is stands in the trial's folder, so that none is begun twice.
"""

from __future__ import annotations

import re
import time
import uuid
from collections.abc import Sequence
from typing import Any

from gsbench.files import write_json
from gsbench.runs import layout
from gsbench.tracking.client import (
    connect,
    default_uri,
    ensure_experiment,
    ensure_parent,
    require_own_artifacts,
    source_tags,
    user_tags,
)
from gsbench.tracking.sink import Point, Summary
from gsbench.tracking.trial import TrackedTrial, read_state

STATE = "mlflow.json"  # in the trial's folder: the run that mirrors it and how far
OWN_DATABASE = "runs/mlflow.db"
TOKEN_TAG = "gsbench.token"
PARENT_TAG = "mlflow.parentRunId"
ERROR_TAG = "error"
MAX_TAG = 5000  # characters of a tag (MLflow's limit)
MAX_VALUE = 6000  # characters of a parameter (MLflow's limit)
MAX_PARAMS = 100  # parameters in a batch
MAX_METRICS = 1000  # metrics in a batch
NOT_IN_A_KEY = re.compile(r"[^a-zA-Z0-9_\-./ ]")  # what MLflow refuses in a picture's name


class MlflowSink:
    """The MLflow run of one trial."""

    state_file = STATE

    def __init__(self, options: dict[str, Any], trial: TrackedTrial, program: str | None) -> None:
        self._options, self._trial, self._program = options, trial, program
        self.client = connect(options["uri"], trial.folder.runs)
        self.run_id = ""
        self._started = 0  # ms since 1970
        self._monitor: Any = None

    def open(self, state: dict[str, Any], results: str | None) -> dict[str, Any]:
        """Open the run (see `gsbench.tracking.sink.Sink`); a deleted one, and one in another tracker, count as none."""
        state = self._known(state, results) or self._create_run()
        self.run_id, self._started = state["run_id"], state["started"]
        address = str(self.client.get_run(self.run_id).info.artifact_uri)
        require_own_artifacts(self.client, address, self._trial.folder.runs)
        if state["complete"] is None:
            self.client.update_run(self.run_id, status="RUNNING")
            if self._program is not None and self._options.get("system_metrics"):
                self._monitor = start_system_metrics(self.run_id, str(self.client.tracking_uri))
        return state

    def log(self, points: Sequence[Point]) -> None:
        """Log numbers in batches."""
        from mlflow.entities import Metric

        metrics = [Metric(point.key, point.value, self._time_of(point.seconds), point.step) for point in points]
        for start in range(0, len(metrics), MAX_METRICS):
            self.client.log_batch(self.run_id, metrics=metrics[start : start + MAX_METRICS])

    def complete(self, summary: Summary) -> None:
        """Log final metrics, pictures as a grid and files, and close the run."""
        from mlflow.entities import RunTag
        from PIL import Image

        self._end_monitor()
        if ERROR_TAG in self.client.get_run(self.run_id).data.tags:  # an earlier attempt failed
            self.client.delete_tag(self.run_id, ERROR_TAG)
        self.log(summary.points)
        self.client.log_batch(self.run_id, tags=[RunTag(key, value) for key, value in summary.tags.items()])
        for folder, path in summary.files:
            self.client.log_artifact(self.run_id, str(path), folder or None)
        for name, path in summary.pictures.items():
            with Image.open(path) as image:
                key = NOT_IN_A_KEY.sub("_", name)
                at = self._time_of(summary.seconds)
                self.client.log_image(self.run_id, image, key=key, step=summary.step, timestamp=at, synchronous=True)
        self.client.set_terminated(self.run_id, "FINISHED")

    def stop(self, status: str, reason: str | None) -> None:
        """Close the run; the ``reason`` of a failure becomes a tag, and its files are shown."""
        self._end_monitor()
        if reason is not None:
            self.client.set_tag(self.run_id, ERROR_TAG, reason[:MAX_TAG])
            for name in (layout.CONFIG, layout.FAILED, layout.LOG):
                if (self._trial.folder.path / name).exists():
                    self.client.log_artifact(self.run_id, str(self._trial.folder.path / name))
        self.client.set_terminated(self.run_id, status)

    def remove(self) -> None:
        """Delete the run."""
        self.client.delete_run(self.run_id)

    def _known(self, state: dict[str, Any], results: str | None) -> dict[str, Any]:
        """Say how far the trial is mirrored here; empty where it never was, was elsewhere, or computed anew since."""
        from mlflow.exceptions import MlflowException

        if state.get("uri") not in (self._uri(), self.client.tracking_uri) or "run_id" not in state:
            return {}
        try:
            run = self.client.get_run(state["run_id"])
        except MlflowException as error:
            if error.error_code != "RESOURCE_DOES_NOT_EXIST":
                raise
            return {}
        if run.info.lifecycle_stage != "active":
            return {}
        if state["complete"] not in (None, results):
            self.client.delete_run(state["run_id"])  # it shows results that are no longer the trial's
            return {}
        return state

    def _create_run(self) -> dict[str, Any]:
        from mlflow.entities import Param, RunTag

        trial, client = self._trial, self.client
        begun = self._begin()
        experiment_id = ensure_experiment(client, trial.values["name"], trial.folder.runs)
        tags = trial.tags() | {TOKEN_TAG: begun["token"]} | user_tags()
        if self._program is not None:
            tags |= source_tags(self._program)
        if sweep := trial.sweep():
            tags[PARENT_TAG] = ensure_parent(client, experiment_id, sweep, trial.folder.runs)
        found = client.search_runs([experiment_id], f"tags.`{TOKEN_TAG}` = '{begun['token']}'", max_results=1)
        run = found[0] if found else client.create_run(experiment_id, tags=tags, run_name=trial.label)
        run_id = run.info.run_id
        params = [Param(key, value[:MAX_VALUE]) for key, value in trial.params().items()]
        for start in range(0, len(params), MAX_PARAMS):
            client.log_batch(run_id, params=params[start : start + MAX_PARAMS], tags=[RunTag("gsbench", "1")])
        return begun | {"run_id": run_id, "logged": {}, "complete": None}

    def _begin(self) -> dict[str, Any]:
        """Note, before a run is created, by what it is found again if nobody hears of its creation."""
        file = self._trial.folder.path / STATE
        state = read_state(file)
        if state.get("uri") == self._uri() and "token" in state and "run_id" not in state:
            return state
        begun = {"uri": self._uri(), "token": uuid.uuid4().hex, "started": int(time.time() * 1000)}
        write_json(file, begun)
        return begun

    def _end_monitor(self) -> None:
        if self._monitor is not None:
            self._monitor.finish()
            self._monitor = None

    def _time_of(self, seconds: float) -> int:
        """The time in ms of what happened after ``seconds`` of training."""
        return int(self._started + 1000 * seconds)

    def _uri(self) -> str:
        """Address of the run: the tracker's address, or a word for the runs folder's own, which may move with it."""
        uri = str(self.client.tracking_uri)
        return OWN_DATABASE if uri == default_uri(self._trial.folder.runs) else uri


def start_system_metrics(run_id: str, uri: str) -> Any:
    """MLflow's own monitor of processors, memory, disk, network and GPUs, which logs to a run until ``finish``."""
    from mlflow.system_metrics.system_metrics_monitor import SystemMetricsMonitor

    monitor = SystemMetricsMonitor(run_id, resume_logging=True, tracking_uri=uri)
    monitor.start()
    return monitor
