"""MLflow's tracker: its address, a client of it, and the tables and experiments that many processes want at once."""

from __future__ import annotations

import getpass
import json
import logging
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from filelock import FileLock

from gsbench.errors import InputError
from gsbench.files import atomic, require_own
from gsbench.runs.layout import ARTIFACTS, DATABASE
from gsbench.system.install import checkout_of

if TYPE_CHECKING:
    from mlflow import MlflowClient

VARIABLE = "MLFLOW_TRACKING_URI"
ADVISORY_LOCK = 0x67736265_6E6368  # "gsbench": the number of our lock in a PostgreSQL database
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
    with _set_up_lock(address, runs):
        _create_sqlite(address)
        client = mlflow.MlflowClient(tracking_uri=address)  # with the first client come the tables
        client.search_experiments(max_results=1)
    return client


def ensure_experiment(client: MlflowClient, name: str, runs: Path) -> str:
    """The id of experiment ``name``, created once under a lock; a deleted one is restored."""
    from mlflow.exceptions import MlflowException

    with _set_up_lock(str(client.tracking_uri), runs):
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


def source_tags(program: str) -> dict[str, str]:
    """The name of the ``program``, and commit and dirty flag of the code: of the folder that it runs in, which holds a
    user's own classes and settings, or else of gsbench's checkout."""
    tags = {"mlflow.source.type": "LOCAL", "mlflow.source.name": program}
    for folder in (Path.cwd(), Path(__file__).resolve().parent):
        checkout = checkout_of(folder)
        if checkout is not None:
            dirty = {} if checkout.edited is None else {"mlflow.source.git.dirty": str(checkout.edited).lower()}
            return tags | {"mlflow.source.git.commit": checkout.commit} | dirty
    return tags


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


# ---- the page that compares the trials of an experiment: final metrics first
#
# MLflow draws one chart for each metric, in alphabetical sections, the final ones last. A view that is shared under a
# name is a tag of its experiment, from which the page takes sections, charts and columns. An MLflow that cannot read
# the tag shows its own page.

VIEW = "gsbench"  # the name of the view
VIEW_TAG = f"mlflow.sharedViewState.{VIEW}"
SECTION = "Final metrics"
BARS = ("psnr", "ssim", "lpips_vgg_raw", "lpips_vgg", "flip", "num_gaussians", "seconds_train")
COLUMNS = ("arm", "scene.name", "seed")  # parameters, beside the runs
MAX_RUNS = 100


def comparison_url(base: str, client: MlflowClient, experiment_id: str) -> str:
    """The page's address on the server ``base``; the experiment is given its view, if it lacks it."""
    wanted = json.dumps(_view(), separators=(",", ":"))
    if client.get_experiment(experiment_id).tags.get(VIEW_TAG) != wanted:
        client.set_experiment_tag(experiment_id, VIEW_TAG, wanted)
    ordered = f"orderByKey={quote('params.`arm`')}&orderByAsc=true"
    words = f"viewStateShareKey={VIEW}&compareRunsMode=CHART&workflowType=machine_learning&{ordered}"
    return f"{base}/#/experiments/{experiment_id}/runs?{words}"


def _view() -> dict[str, Any]:
    charts = [_chart("BAR", key, metricKey=key, displayName=key) for key in BARS]
    charts.append(
        _chart("PARALLEL", "all", selectedParams=["arm"], selectedMetrics=["num_gaussians", "psnr"], showAllRuns=True)
    )
    section = {"uuid": VIEW, "name": SECTION, "display": True, "isReordered": True, "deleted": False}
    return {
        "compareRunSections": [section],
        "compareRunCharts": charts,
        "isAccordionReordered": True,  # else sections are sorted by name
        "hideEmptyCharts": True,
        "runsHiddenMode": "SHOW_ALL",  # else charts show the ten youngest runs, and the baseline is mostly the oldest
        "selectedColumns": [f"params.`{name}`" for name in COLUMNS] + [f"metrics.`{name}`" for name in BARS],
    }


def _chart(kind: str, name: str, **settings: Any) -> dict[str, Any]:
    common = {"runsCountToCompare": MAX_RUNS, "metricSectionId": VIEW, "deleted": False, "isGenerated": False}
    return {"type": kind, "uuid": f"{VIEW}-{name}"} | common | settings
