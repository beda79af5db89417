"""A runs folder with a database, and a PostgreSQL server for one test."""

import os
import shutil
import subprocess
from pathlib import Path
from shlex import split

import pytest

from gsbench.tracking import connect, ensure_experiment
from tests.tracking.helpers import free_port


@pytest.fixture(scope="session")
def database(tmp_path_factory):
    """An empty database, for tests to copy: making one takes MLflow seconds."""
    folder = tmp_path_factory.mktemp("database")
    connect(None, folder)
    return folder / "mlflow.db"


@pytest.fixture(scope="module")
def runs(database, tmp_path_factory):
    """A runs folder with a database."""
    folder = tmp_path_factory.mktemp("runs")
    shutil.copy(database, folder)
    ensure_experiment(connect(None, folder), "tracked", folder)
    return folder


@pytest.fixture
def postgresql(tmp_path):
    """The address of an empty database in a new PostgreSQL server; skips without PostgreSQL."""
    pytest.importorskip("psycopg2", reason="needs psycopg2-binary")
    homes = Path("/usr/lib/postgresql").glob("*/bin")
    newest = sorted(homes, key=lambda path: -int(path.parent.name))
    places = os.pathsep.join(map(str, newest)) or None
    initdb = shutil.which("initdb", path=places) or shutil.which("initdb")
    if initdb is None:
        pytest.skip("needs a PostgreSQL server (apt-get install postgresql)")
    home = Path(initdb).parent
    data = tmp_path / "postgresql"
    data.mkdir()
    prefix = []
    if os.geteuid() == 0:  # the server refuses to run as root
        if shutil.which("runuser") is None:
            pytest.skip("PostgreSQL does not run as root, and there is no runuser")
        prefix = split("runuser -u nobody --")
        shutil.chown(data, "nobody")
        # a worker of pytest-xdist has a folder of its own
        for folder in (tmp_path, *tmp_path.parents[:3]):
            folder.chmod(folder.stat().st_mode | 0o011)
    port = free_port()

    def run(*words):
        command = [*prefix, *words]
        subprocess.run(command, check=True, capture_output=True, timeout=300)

    run(str(home / "initdb"), "-D", str(data), "-U", "gsbench", "--auth=trust", "--no-sync")
    settings = (
        f"-p {port} -c listen_addresses=127.0.0.1 -c unix_socket_directories={data} -c fsync=off"
    )
    control = [str(home / "pg_ctl"), "-D", str(data)]
    run(*control, "-l", str(data / "log"), "-w", "-o", settings, "start")
    yield f"postgresql+psycopg2://gsbench@127.0.0.1:{port}/postgres"
    stop = [*prefix, *control, "-m", "immediate", "stop"]
    subprocess.run(stop, check=False, timeout=300)
