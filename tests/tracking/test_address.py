"""A tracker that a stranger's file names gets nothing unless the user types its address."""

import os
import shutil
import sqlite3
import struct
from contextlib import closing

import pytest

from gsbench.cli import run
from gsbench.tracking import connect, default_uri, tracker_uri
from gsbench.tracking.mlflow_sink import VARIABLE
from tests.helpers import change_json, read_json, refusal, write
from tests.tracking.helpers import (
    STATE,
    ended_trial,
    found_runs,
    free_port,
    mirror_trial,
    options,
)


def test_the_address_is_the_configured_one_else_the_environments_else_the_runs_folders(
    tmp_path, monkeypatch
):
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    assert tracker_uri(None, tmp_path) == default_uri(tmp_path) == f"sqlite:///{tmp_path}/mlflow.db"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://127.0.0.1:1")
    assert tracker_uri(None, tmp_path) == "http://127.0.0.1:1"
    assert tracker_uri("http://127.0.0.1:2", tmp_path) == "http://127.0.0.1:2"


@pytest.mark.parametrize("kind", ["sqlite", "http"])
@pytest.mark.slow
def test_sync_sends_nothing_to_a_tracker_that_was_not_typed(kind, tmp_path, monkeypatch, capfd):
    runs, target = tmp_path / "runs", tmp_path / "elsewhere/theirs.db"
    target.parent.mkdir()
    address = f"sqlite:///{target}" if kind == "sqlite" else f"http://127.0.0.1:{free_port()}"
    ended_trial(runs, name="theirs", uri=address)
    monkeypatch.setenv("GSBENCH_RUNS", str(runs))
    monkeypatch.delenv(VARIABLE, raising=False)
    assert run(["sync", "theirs"]) == 0
    said = capfd.readouterr().out
    assert f"names the tracker {address}, and --uri {address} was not typed" in said
    assert "0 trials mirrored" in said
    assert not list(target.parent.iterdir())
    if kind == "sqlite":
        assert run(["sync", "theirs", "--uri", address]) == 0
        assert target.is_file()


@pytest.mark.parametrize("lacking", ["scene", "densify", "tracking"])
def test_sync_leaves_out_a_trial_whose_configuration_lacks_a_group(
    lacking, tmp_path, monkeypatch, capfd
):
    folder, _ = ended_trial(tmp_path, name="theirs")
    content = read_json(folder / "config.yaml")
    del content[lacking]
    write(folder / "config.yaml", content)
    monkeypatch.setenv("GSBENCH_RUNS", str(tmp_path))
    assert run(["sync", "theirs"]) == 0
    said = capfd.readouterr()
    assert f"left out: {folder / 'config.yaml'} is damaged: it lacks '{lacking}'" in said.out
    assert said.err == ""


def test_a_link_among_the_artifacts_is_not_followed(tmp_path, database):
    runs, private = tmp_path / "runs", tmp_path / "private"
    private.write_text("secret")
    folder, values = ended_trial(runs, name="theirs")
    shutil.copy(database, runs)
    client = connect(None, runs)
    mirror_trial(options(), folder, values)
    (made,) = found_runs(client, "theirs")
    shown = runs / f"mlartifacts/theirs/{made.info.run_id}/artifacts/config.yaml"
    shown.unlink()
    shown.symlink_to(private)
    change_json(folder / STATE, complete=None)
    with refusal("follows no links"):
        mirror_trial(options(), folder, values)
    assert private.read_text() == "secret"


def journal_naming(other, pages):
    """A journal as SQLite leaves it after a crash, which tells it to delete the file ``other``.

    The layout is that of https://www.sqlite.org/fileformat2.html#the_rollback_journal.
    """
    magic, name = bytes.fromhex("d9d505f920a163d7"), os.fsencode(other)
    head = magic + struct.pack(">5I", 0, 1, pages, 512, 4096)
    end = struct.pack(">I", 2**30 // 4096 + 1) + name + struct.pack(">2I", len(name), sum(name))
    return head.ljust(512, b"\0") + end + magic


def test_a_journal_of_a_database_deletes_no_file(tmp_path, database, monkeypatch, capfd):
    runs, private = tmp_path / "runs", write(tmp_path / "private", "secret")
    ended_trial(runs, name="theirs")
    shutil.copy(database, runs)
    database = runs / "mlflow.db"
    journal = journal_naming(private, database.stat().st_size // 4096)
    write(runs / "mlflow.db-journal", journal)
    monkeypatch.setenv("GSBENCH_RUNS", str(runs))
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr("gsbench.verbs.servers.subprocess.Popen", None)
    for command in (["sync", "theirs"], ["ui"]):
        assert run(command) in (1, 2)
        assert "mlflow.db-journal would delete another file: remove it" in capfd.readouterr().err
        assert private.exists()
    # The journal is what SQLite takes for one.
    with closing(sqlite3.connect(database)) as connection:
        connection.execute("SELECT * FROM experiments")
    assert not private.exists()


@pytest.mark.parametrize("name", ["mlflow.db", "mlflow.db-journal"])
def test_no_link_to_a_database_is_opened_by_ui(name, tmp_path, monkeypatch, refused):
    private = write(tmp_path / "private", "secret")
    for place in (tmp_path / "runs" / "one", tmp_path / "runs" / "two"):
        place.mkdir(parents=True)
    write(tmp_path / "runs" / "mlflow.db", b"")
    (tmp_path / "runs" / name).unlink(missing_ok=True)
    (tmp_path / "runs" / name).symlink_to(private)
    monkeypatch.setenv("GSBENCH_RUNS", str(tmp_path / "runs"))
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr("gsbench.verbs.servers.subprocess.Popen", None)
    assert "not a regular file" in refused("ui")
    assert private.read_text() == "secret"


@pytest.mark.parametrize("address", ["./mlruns", "mlruns", "file:./mlruns", "http:/host"])
def test_an_address_that_is_a_folder_is_refused_in_one_line(address, refused):
    said = refused("scene=courtyard", f"tracking.uri={address}", "--dry-run")
    assert "tracking.uri must be an address such as http://HOST:PORT" in said


@pytest.mark.parametrize(
    "name, is_odd",
    [
        *((name, True) for name in ("a%41b", "a?b", "/".join(["x" * 200] * 6))),
        *((name, False) for name in ("a'b", 'a"b c#d')),
    ],
)
def test_a_runs_folder_without_an_address_gets_no_database(name, is_odd, tmp_path, monkeypatch):
    """MLflow would make one elsewhere, or try for minutes; the trial's files are complete."""
    monkeypatch.delenv(VARIABLE, raising=False)
    runs = tmp_path / name
    runs.mkdir(parents=True)
    with refusal("MLflow has no database in the runs folder" if is_odd else None):
        connect(None, runs)
    assert list(tmp_path.rglob("*.db")) == [runs / "mlflow.db"] * (not is_odd)
    assert len(list(tmp_path.iterdir())) == 1
