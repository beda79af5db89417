"""A tracker that a file of somebody else names gets nothing unless its address is typed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from gsbench.cli import run
from gsbench.tracking.address import VARIABLE, untyped_address
from tests.tracking.helpers import free_port

from .helpers import begin_trial, trial_values, write_trial


def test_an_address_counts_where_it_is_typed_or_of_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    assert untyped_address({"uri": None}) is None
    assert untyped_address({"uri": "http://a"}) == "http://a"
    assert untyped_address({"uri": "http://a", "enabled": False}) is None
    assert untyped_address({"uri": "http://a"}, "http://a") is None
    assert untyped_address({"uri": "http://a"}, "http://a/") == "http://a"
    monkeypatch.setenv(VARIABLE, "http://a")
    assert untyped_address({"uri": "http://a"}) is None


@pytest.mark.parametrize("kind", ["sqlite", "http"])
@pytest.mark.slow
def test_sync_leaves_a_strange_tracker_alone(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    runs, target = tmp_path / "runs", tmp_path / "elsewhere" / "theirs.db"
    target.parent.mkdir()
    address = f"sqlite:///{target}" if kind == "sqlite" else f"http://127.0.0.1:{free_port()}"
    values = trial_values(runs, name="theirs")
    folder = begin_trial(values, address)
    write_trial(folder, values)
    results = json.loads((folder / "results.json").read_text()) | {"status": "complete"}
    (folder / "results.json").write_text(json.dumps(results))
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
