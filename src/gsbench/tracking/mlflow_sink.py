"""MLflow: the tracker's address, a client of it, and a trial as a run there.

Each metric's time is a function of the files, so that MLflow, which drops exact repetitions, holds it once even if it
was sent twice. Which run it is stands in the trial's folder, so that none is begun twice.
"""

from __future__ import annotations

import getpass
import logging
import os
import re
import time
import uuid
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from filelock import FileLock

from gsbench.errors import InputError
from gsbench.files import atomic, require_own, write_json
from gsbench.runs import layout
from gsbench.runs.layout import ARTIFACTS, DATABASE
from gsbench.tracking.trial import Point, Summary, TrackedTrial

if TYPE_CHECKING:
    from mlflow import MlflowClient

VARIABLE = "MLFLOW_TRACKING_URI"
LOCK = ".mlflow.lock"  # in the runs folder: one process at a time makes tables and experiments
KIND = {"mlflow.experimentKind": "custom_model_development"}  # else its page opens as that of a chat program
# Settings against printing, phoning home and hanging for minutes.
SETTINGS = {
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "MLFLOW_LOGGING_LEVEL": "WARNING",
    "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "2",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "20",
    "PGCONNECT_TIMEOUT": "20",
    # A machine that vanished within a transaction would hold its rows until TCP gives up, after hours.
    "PGOPTIONS": "-c idle_in_transaction_session_timeout=60s",
}


def default_uri(runs: Path) -> str:
    return f"sqlite:///{runs}/{DATABASE}"


def tracker_uri(uri: str | None, runs: Path) -> str:
    """The tracker's address: the configured ``uri``, else MLFLOW_TRACKING_URI, else the database in the runs folder."""
    return uri or os.environ.get(VARIABLE) or default_uri(runs)


def untyped_address(options: Mapping[str, Any], typed: str | None = None) -> str | None:
    """The tracker's address that the settings ``tracking`` of a file name; None where it may be used.

    That is so where they name none, the one that was ``typed``, or that of the environment.
    """
    address = options.get("uri")
    if not options.get("enabled", True) or not address or address in (typed, os.environ.get(VARIABLE)):
        return None
    return str(address)


def connect(uri: str | None, runs: Path) -> MlflowClient:
    """A client of the tracker; creates a new database under a lock, since MLflow's own set-up races."""
    for name, value in SETTINGS.items():
        os.environ.setdefault(name, value)
    import mlflow

    for logger in ("mlflow", "alembic"):  # importing mlflow has set their levels
        logging.getLogger(logger).setLevel(logging.WARNING)
    address = tracker_uri(uri, runs)
    for name in (DATABASE, ARTIFACTS):
        require_own(runs, runs / name)
    with FileLock(runs / LOCK):
        _create_sqlite(address)
        client = mlflow.MlflowClient(tracking_uri=address)  # with the first client come the tables
        client.search_experiments(max_results=1)
    return client


def ensure_experiment(client: MlflowClient, name: str, runs: Path) -> str:
    """The id of experiment ``name``, created once under a lock; a deleted one is restored."""
    from mlflow.exceptions import MlflowException

    with FileLock(runs / LOCK):
        found = client.get_experiment_by_name(name)
        if found is None:
            served = str(client.tracking_uri).startswith(("http:", "https:"))  # then the server says where
            location = None if served else (runs / ARTIFACTS / name).as_uri()
            with suppress(MlflowException):  # a rival on another machine was first, or what follows says what is wrong
                return str(client.create_experiment(name, artifact_location=location, tags=KIND))
            found = client.get_experiment_by_name(name)
        if found is None:
            raise RuntimeError(f"MLflow could not create the experiment {name}")
        if found.lifecycle_stage != "active":
            client.restore_experiment(found.experiment_id)
        for key, value in KIND.items():
            if key not in found.tags:  # somebody else's experiment of this name
                client.set_experiment_tag(found.experiment_id, key, value)
        return str(found.experiment_id)


def require_own_artifacts(client: MlflowClient, address: str, runs: Path) -> None:
    """Raise InputError where a run of the runs folder's own database has its artifacts outside of that folder.

    ``address`` is what the run says. Another tracker was typed, and says itself where artifacts go.
    """
    from mlflow.utils.file_utils import local_file_uri_to_path

    if client.tracking_uri != default_uri(runs):
        return
    # The database of a stranger's runs folder may name a server, which would get the files and our password.
    place = Path(local_file_uri_to_path(address))
    if not place.is_relative_to(runs / ARTIFACTS) or ".." in place.parts:
        raise InputError(
            f"{runs / DATABASE} would send artifacts to {address}; if this runs folder was moved, remove {DATABASE} "
            f"and {ARTIFACTS} there: `gsbench sync` makes them again"
        )
    require_own(runs, place, below=True)


def user_tags() -> dict[str, str]:
    """The user's name, where the system has one."""
    try:
        return {"mlflow.user": getpass.getuser()}
    except (KeyError, OSError, ImportError):  # a container's nameless user; Windows
        return {}


def _create_sqlite(uri: str) -> None:
    """Make the database file of a SQLite address, if it is missing, whole or not at all.

    MLflow's migrations of SQLite are no transaction: a process that was killed within them would leave tables that no
    later one can use.
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

    def __init__(self, options: dict[str, Any], trial: TrackedTrial) -> None:
        self._trial = trial
        self.client = connect(options["uri"], trial.folder.runs)
        self.run_id = ""
        self._started = 0  # ms since 1970

    def open(self, state: dict[str, Any], results: str | None) -> dict[str, Any]:
        """Open the run (see `gsbench.tracking.trial.Sink`); a deleted one and one in another tracker count as none."""
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
