"""MLflow: the tracker's address, its client, and a trial as an MLflow run.

A metric's time is computed from the trial's files, not from the clock. MLflow drops exact
repetitions, so a metric that is sent twice is stored once. A tag of the run has the token that the
trial's folder keeps, so that no trial gets two runs.
"""

from __future__ import annotations

import logging
import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import psutil
from filelock import FileLock

from gsbench.errors import InputError
from gsbench.files import atomic, require_no_links
from gsbench.parsing import read_tail
from gsbench.runs.layout import ARTIFACTS, DATABASE
from gsbench.tracking.sinks import Run
from gsbench.tracking.trial import TrackedTrial, Update

if TYPE_CHECKING:
    from mlflow import MlflowClient

# bytes of a database's path: SQLite opens 512, with "-journal" after it
MAX_PATH = 500
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
    """The address of the runs folder's own database."""
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
        if address == default_uri(runs):
            _require_plain(runs / DATABASE)
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


JOURNAL_END = bytes.fromhex("d9d505f920a163d7")  # of a journal that names another file


def require_own_journal(uri: str) -> Path | None:
    """The file of a SQLite address, else None; InputError if its journal names another file.

    SQLite would delete that file when it opens the database, and the runs folder may be a
    stranger's. Neither MLflow nor gsbench writes such journals; others are rolled back.
    """
    import sqlalchemy

    name = sqlalchemy.engine.make_url(uri).database if uri.startswith("sqlite:") else None
    if not name or name == ":memory:":
        return None
    database = Path(name)  # without a slash at its end, which SQLite leaves out, too
    journal = Path(f"{database}-journal")
    with suppress(FileNotFoundError):
        if read_tail(journal, len(JOURNAL_END)) == JOURNAL_END:
            raise InputError(f"{journal} would delete another file: remove it")
    return database


def _require_plain(database: Path) -> None:
    """Raise InputError if MLflow would open another file, or none.

    In an address, ``%41`` is an A and ``?`` begins a query, but MLflow also uses it as a path. A
    path that SQLite cannot open would cost minutes of tries.
    """
    odd = "a % or ?" if set("%?") & set(str(database)) else ""
    if not odd and len(os.fsencode(database)) > MAX_PATH:
        odd = f"more than {MAX_PATH} bytes"
    if odd:
        raise InputError(
            f"MLflow has no database in the runs folder, whose path has {odd}: give tracking.uri, "
            "or another runs folder"
        )


def _create_sqlite(uri: str) -> None:
    """Make the database file of a SQLite address if it is missing, completely or not at all.

    MLflow's migrations of SQLite are no transaction: a process that is killed during them leaves
    tables that no later process can use.
    """
    database = require_own_journal(uri)
    if database is None or database.exists():
        return
    from mlflow.store.tracking.sqlalchemy_store import SqlAlchemyStore

    with atomic(database) as temporary:
        store = SqlAlchemyStore(f"sqlite:///{temporary}", str(database.parent / ARTIFACTS))
        store.engine.dispose()


# ---- a trial

TOKEN_TAG = "gsbench.token"
ERROR_TAG = "error"
MAX_TAG = 5000  # characters of a tag (MLflow's limit)
MAX_VALUE = 500  # characters of a parameter, which every server of MLflow 2 and later takes


@dataclass
class MLflow:
    """The MLflow run of a trial in the tracker ``uri`` (`tracker_uri`)."""

    uri: str | None = None

    def open(self, trial: TrackedTrial, run: Run) -> str:
        """Open the run as `gsbench.tracking.sinks.Sink` says; a deleted one is replaced."""
        runs = trial.folder.runs
        self._client, self._run = connect(self.uri, runs), run
        experiment = ensure_experiment(self._client, trial.values["name"], runs)
        if run.replaces and (old := self._found(experiment, run.replaces)):
            self._client.delete_run(old.info.run_id)
        found = self._found(experiment, run.token)
        if found is None:
            tags = {TOKEN_TAG: run.token, "mlflow.user": psutil.Process().username()}
            found = self._client.create_run(experiment, tags=tags, run_name=trial.label)
        self._id = str(found.info.run_id)
        require_own_artifacts(self._client, str(found.info.artifact_uri), runs)
        if not (run.complete and self._id == run.id):
            self._client.update_run(self._id, status="RUNNING")
            if ERROR_TAG in found.data.tags:  # an earlier attempt failed
                self._client.delete_tag(self._id, ERROR_TAG)
        return self._id

    def send(self, update: Update) -> None:
        """Show what is new; a failure's reason is a tag."""
        from mlflow.entities import Metric, Param, RunTag

        named = dict(update.tags)
        if update.reason is not None:
            named[ERROR_TAG] = update.reason
        self._client.log_batch(
            self._id,
            metrics=[
                Metric(scalar.key, scalar.value, self._time_of(scalar.seconds), scalar.step)
                for scalar in update.scalars
            ],
            params=[Param(key, value[:MAX_VALUE]) for key, value in update.params.items()],
            tags=[RunTag(key, text[:MAX_TAG]) for key, text in named.items()],
        )
        for name, path in update.files.items():
            self._client.log_artifact(self._id, str(path), name.rpartition("/")[0] or None)
        for picture in update.pictures:
            self._client.log_image(
                self._id,
                picture.pixels,
                key=picture.key,
                step=picture.step,
                timestamp=self._time_of(picture.seconds),
                synchronous=True,
            )
        if update.status is not None:
            self._client.set_terminated(self._id, update.status)

    def _found(self, experiment: str, token: str | None) -> Any:
        same = f"tags.`{TOKEN_TAG}` = '{token}'"
        return next(iter(self._client.search_runs([experiment], same, max_results=1)), None)

    def _time_of(self, seconds: float) -> int:
        """The time, in ms since 1970, ``seconds`` of training after the run's start."""
        return int(self._run.started + 1000 * seconds)
