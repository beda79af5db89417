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
    require_own_artifacts,
    source_tags,
    user_tags,
)
from gsbench.tracking.sink import Point, Summary
from gsbench.tracking.trial import TrackedTrial

STATE = "mlflow.json"  # in the trial's folder: the run that mirrors it and how far
OWN_DATABASE = "runs/mlflow.db"
TOKEN_TAG = "gsbench.token"
PARAMS_TAG = "gsbench"  # set when all settings are there
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
        self._trial, self._program = trial, program
        self.client = connect(options["uri"], trial.folder.runs)
        self.run_id = ""
        self._started = 0  # ms since 1970

    def open(self, state: dict[str, Any], results: str | None) -> dict[str, Any]:
        """Open the run (see `gsbench.tracking.sink.Sink`); a deleted one, and one in another tracker, count as none."""
        uri = self._uri()
        experiment_id = ensure_experiment(self.client, self._trial.values["name"], self._trial.folder.runs)
        run = None
        if state.get("uri") in (uri, self.client.tracking_uri) and state.get("token"):
            run = self._find_run(experiment_id, state["token"])
        if run is not None and state["complete"] not in (None, results):
            self.client.delete_run(run.info.run_id)  # it shows results that are no longer the trial's
            run = None
        if run is None:
            token = uuid.uuid4().hex
            state = {"uri": uri, "token": token, "started": int(time.time() * 1000), "complete": None, "logged": {}}
            # Before the run is there, so that it is found again if nobody hears of its creation.
            write_json(self._trial.folder.path / STATE, state)
            run = self._create_run(experiment_id, token)
        self.run_id, self._started = run.info.run_id, state["started"]
        if PARAMS_TAG not in run.data.tags:
            self._log_params()
        require_own_artifacts(self.client, str(run.info.artifact_uri), self._trial.folder.runs)
        if state["complete"] is None:
            self.client.update_run(self.run_id, status="RUNNING")
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
        if reason is not None:
            self.client.set_tag(self.run_id, ERROR_TAG, reason[:MAX_TAG])
            for name in (layout.CONFIG, layout.FAILED, layout.LOG):
                if (self._trial.folder.path / name).exists():
                    self.client.log_artifact(self.run_id, str(self._trial.folder.path / name))
        self.client.set_terminated(self.run_id, status)

    def _find_run(self, experiment_id: str, token: str) -> Any:
        """The run that has the token; None where there is none, or it was deleted."""
        found = self.client.search_runs([experiment_id], f"tags.`{TOKEN_TAG}` = '{token}'", max_results=1)
        return found[0] if found else None

    def _create_run(self, experiment_id: str, token: str) -> Any:
        trial, client = self._trial, self.client
        tags = trial.tags() | {TOKEN_TAG: token} | user_tags()
        if self._program is not None:
            tags |= source_tags(self._program)
        return client.create_run(experiment_id, tags=tags, run_name=trial.label)

    def _log_params(self) -> None:
        from mlflow.entities import Param

        params = [Param(key, value[:MAX_VALUE]) for key, value in self._trial.params().items()]
        for start in range(0, len(params), MAX_PARAMS):
            self.client.log_batch(self.run_id, params=params[start : start + MAX_PARAMS])
        self.client.set_tag(self.run_id, PARAMS_TAG, "1")

    def _time_of(self, seconds: float) -> int:
        """The time in ms of what happened after ``seconds`` of training."""
        return int(self._started + 1000 * seconds)

    def _uri(self) -> str:
        """Address of the run: the tracker's address, or a word for the runs folder's own, which may move with it."""
        uri = str(self.client.tracking_uri)
        return OWN_DATABASE if uri == default_uri(self._trial.folder.runs) else uri
