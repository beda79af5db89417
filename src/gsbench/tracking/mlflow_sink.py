"""MLflow: the tracker's address, its client, and a trial as an MLflow run.

A metric's time is computed from the trial's files, not from the clock. MLflow drops exact
repetitions, so a metric that is sent twice is stored once. The trial's folder keeps the run's id,
so that no trial gets two runs.
"""

from __future__ import annotations

import logging
import os
import time
import uuid
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import psutil
from filelock import FileLock

from gsbench.errors import InputError
from gsbench.files import atomic, require_no_links, write_json
from gsbench.runs import layout
from gsbench.runs.layout import ARTIFACTS, DATABASE
from gsbench.tracking.sinks import MirrorState, Scalar, Summary, TrackedTrial

if TYPE_CHECKING:
    from mlflow import MlflowClient

VARIABLE = "MLFLOW_TRACKING_URI"
LOCK = ".mlflow.lock"  # in the runs folder: one process at a time makes tables and experiments
# Without this tag, the experiment's page opens in the view for chat models.
KIND = {"mlflow.experimentKind": "custom_model_development"}
# Environment variables against printing, telemetry and waits of minutes.
SETTINGS = {
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "MLFLOW_LOGGING_LEVEL": "WARNING",
    "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "2",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "20",
    "PGCONNECT_TIMEOUT": "20",
    # A machine that vanishes within a transaction would lock its rows until TCP gives up, after
    # hours.
    "PGOPTIONS": "-c idle_in_transaction_session_timeout=60s",
}


def default_uri(runs: Path) -> str:
    return f"sqlite:///{runs}/{DATABASE}"


def tracker_uri(uri: str | None, runs: Path) -> str:
    """The tracker's address: ``uri``, else MLFLOW_TRACKING_URI, else the runs folder's database."""
    return uri or os.environ.get(VARIABLE) or default_uri(runs)


def absolute_address(uri: str) -> str:
    """A tracker's address as a process that starts in another folder needs it."""
    place = uri.removeprefix("sqlite:///")
    if place != uri:
        return uri if place in ("", ":memory:") else f"sqlite:///{os.path.abspath(place)}"
    return uri if ":" in uri else os.path.abspath(uri)


def connect(uri: str | None, runs: Path) -> MlflowClient:
    """A client of the tracker.

    Creates a missing database under a lock, since MLflow's own set-up has races.
    """
    for name, value in SETTINGS.items():
        os.environ.setdefault(name, value)
    import mlflow

    for logger in ("mlflow", "alembic"):  # only now: importing mlflow sets their levels
        logging.getLogger(logger).setLevel(logging.WARNING)
    address = tracker_uri(uri, runs)
    for name in (DATABASE, ARTIFACTS):
        require_no_links(runs, runs / name)
    with FileLock(runs / LOCK):
        _create_sqlite(address)
        client = mlflow.MlflowClient(tracking_uri=address)  # the first client creates the tables
        client.search_experiments(max_results=1)
    return client


def ensure_experiment(client: MlflowClient, name: str, runs: Path) -> str:
    """The id of experiment ``name``: created under a lock if missing, restored if deleted."""
    from mlflow.exceptions import MlflowException

    with FileLock(runs / LOCK):
        experiment = client.get_experiment_by_name(name)
        if experiment is None:
            # a server chooses the location itself
            served = str(client.tracking_uri).startswith(("http:", "https:"))
            location = None if served else (runs / ARTIFACTS / name).as_uri()
            # a process on another machine may have created it in the meantime
            with suppress(MlflowException):
                return str(client.create_experiment(name, artifact_location=location, tags=KIND))
            experiment = client.get_experiment_by_name(name)
        if experiment is None:
            raise RuntimeError(f"MLflow could not create the experiment {name}")
        if experiment.lifecycle_stage != "active":
            client.restore_experiment(experiment.experiment_id)
        for key, value in KIND.items():
            if key not in experiment.tags:  # another program's experiment of this name
                client.set_experiment_tag(experiment.experiment_id, key, value)
        return str(experiment.experiment_id)


def require_own_artifacts(client: MlflowClient, address: str, runs: Path) -> None:
    """Raise InputError if a run in the runs folder's database has its artifacts elsewhere.

    ``address`` is the run's artifact location. Other trackers are not checked: the user typed them.
    """
    from mlflow.utils.file_utils import local_file_uri_to_path

    if client.tracking_uri != default_uri(runs):
        return
    # The runs folder may be a stranger's, and its database may name a server that would get files
    # and the user's password.
    place = Path(local_file_uri_to_path(address))
    if not place.is_relative_to(runs / ARTIFACTS) or ".." in place.parts:
        raise InputError(
            f"{runs / DATABASE} would send artifacts to {address}; if this runs folder was moved, "
            f"remove {DATABASE} and {ARTIFACTS} there: `gsbench sync` makes them again"
        )
    require_no_links(runs, place, below=True)


def _create_sqlite(uri: str) -> None:
    """Make the database file of a SQLite address if it is missing, completely or not at all.

    MLflow's migrations of SQLite are no transaction: a process that is killed during them leaves
    tables that no later process can use.
    """
    import sqlalchemy
    from mlflow.store.tracking.sqlalchemy_store import SqlAlchemyStore

    if not uri.startswith("sqlite:"):
        return
    name = sqlalchemy.engine.make_url(uri).database
    if not name or name == ":memory:" or Path(name).exists():
        return
    with atomic(Path(name)) as temporary:
        store = SqlAlchemyStore(f"sqlite:///{temporary}", str(Path(name).parent / ARTIFACTS))
        store.engine.dispose()


# ---- a trial

STATE = "mlflow.json"  # in the trial's folder: which run mirrors it, and how far
OWN_DATABASE = "runs/mlflow.db"  # stands in the state for the database of the runs folder
TOKEN_TAG = "gsbench.token"
PARAMS_TAG = "gsbench"  # set once all settings are logged
ERROR_TAG = "error"
NOTE = "mlflow.note.content"  # the description, in Markdown
MAX_TAG = 5000  # characters of a tag (MLflow's limit)
# characters of a parameter: MLflow's limit, and the limits of older servers
MAX_VALUES = (6000, 500, 250)


class MlflowSink:
    """The MLflow run of one trial."""

    name, state_file = "MLflow", STATE

    def __init__(self, options: dict[str, Any], trial: TrackedTrial) -> None:
        self._trial = trial
        self.client = connect(options["uri"], trial.folder.runs)
        self.run_id = ""
        self._started = 0  # ms since 1970

    def open(self, state: MirrorState, results: str | None) -> MirrorState:
        """Open the run (see `gsbench.tracking.sinks.Sink`).

        A deleted run, or one in another tracker, is replaced.
        """
        runs, uri = self._trial.folder.runs, str(self.client.tracking_uri)
        if uri == default_uri(runs):
            uri = OWN_DATABASE  # a runs folder may be moved
        experiment_id = ensure_experiment(self.client, self._trial.values["name"], runs)
        run = None
        if state.uri == uri and state.token:
            same = f"tags.`{TOKEN_TAG}` = '{state.token}'"
            run = next(iter(self.client.search_runs([experiment_id], same, max_results=1)), None)
        if run is not None and state.complete not in (None, results):
            # it shows results that are no longer the trial's
            self.client.delete_run(run.info.run_id)
            run = None
        if run is None:
            token = uuid.uuid4().hex
            state = MirrorState(uri=uri, token=token, started=int(time.time() * 1000))
            # Written before the run is created, so that its token finds it even if the server's
            # answer is lost.
            write_json(self._trial.folder.path / STATE, state.to_json())
            user = psutil.Process().username()
            tags = self._trial.tags() | {TOKEN_TAG: token, "mlflow.user": user}
            run = self.client.create_run(experiment_id, tags=tags, run_name=self._trial.label)
        self.run_id, self._started = run.info.run_id, state.started
        if PARAMS_TAG not in run.data.tags:
            self._log_params()
        require_own_artifacts(self.client, str(run.info.artifact_uri), runs)
        if state.complete is None:
            self.client.update_run(self.run_id, status="RUNNING")
        return state

    def log(self, scalars: Sequence[Scalar]) -> None:
        """Log numbers, which MLflow sends in batches."""
        from mlflow.entities import Metric

        metrics = [
            Metric(scalar.key, scalar.value, self._time_of(scalar.seconds), scalar.step)
            for scalar in scalars
        ]
        self.client.log_batch(self.run_id, metrics=metrics)

    def complete(self, summary: Summary) -> None:
        """Log the final metrics, pictures and files, and close the run."""
        from mlflow.entities import RunTag

        if ERROR_TAG in self.client.get_run(self.run_id).data.tags:  # an earlier attempt failed
            self.client.delete_tag(self.run_id, ERROR_TAG)
        self.log(summary.scalars)
        tags = summary.tags | {NOTE: summary.note[:MAX_TAG]}
        self.client.log_batch(self.run_id, tags=[RunTag(key, value) for key, value in tags.items()])
        for folder, path in summary.files:
            self.client.log_artifact(self.run_id, str(path), folder or None)
        at = self._time_of(summary.seconds)
        for key, picture in summary.pictures.items():
            self.client.log_image(
                self.run_id, picture, key=key, step=summary.step, timestamp=at, synchronous=True
            )
        self.client.set_terminated(self.run_id, "FINISHED")

    def stop(self, status: str, reason: str | None) -> None:
        """Close the run. The ``reason`` of a failure becomes a tag, and its files are uploaded."""
        if reason is not None:
            self.client.set_tag(self.run_id, ERROR_TAG, reason[:MAX_TAG])
            for name in (layout.CONFIG, layout.FAILED, layout.LOG):
                if (self._trial.folder.path / name).exists():
                    self.client.log_artifact(self.run_id, str(self._trial.folder.path / name))
        self.client.set_terminated(self.run_id, status)

    def _log_params(self) -> None:
        from mlflow.entities import Param
        from mlflow.exceptions import MlflowException

        values = self._trial.params()
        for limit in MAX_VALUES:
            params = [Param(key, value[:limit]) for key, value in values.items()]
            try:
                self.client.log_batch(self.run_id, params=params)
                break
            except MlflowException:  # perhaps a value is too long for this server
                if limit == MAX_VALUES[-1] or max(map(len, values.values())) <= MAX_VALUES[-1]:
                    raise
        self.client.set_tag(self.run_id, PARAMS_TAG, "1")

    def _time_of(self, seconds: float) -> int:
        """The time, in ms since 1970, ``seconds`` of training after the run's start."""
        return int(self._started + 1000 * seconds)
