"""A trial's end, whatever its code does."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import pytest

from gsbench.errors import TrainingError
from gsbench.pipeline.trial import _recorded_failures
from gsbench.runs.trial_folder import TrialFolder


@pytest.mark.parametrize("code", [0, None, 3, "text"])
def test_code_that_ends_the_process_is_a_failure(code: int | str | None, tmp_path: Path) -> None:
    folder = TrialFolder(tmp_path / "a" / "b" / "c" / "d" / "x")
    folder.path.mkdir(parents=True)
    with pytest.raises(TrainingError, match="ended the process"), _recorded_failures({"seed": 0}, folder):
        sys.exit(code)
    assert "ended the process" in json.loads((folder.path / "failed.json").read_text())["message"]


def test_an_end_at_once_is_a_failure_here_and_none_in_a_child(tmp_path: Path) -> None:
    folder = TrialFolder(tmp_path / "a" / "b" / "c" / "d" / "x")
    folder.path.mkdir(parents=True)
    end_at_once = os._exit
    with _recorded_failures({"seed": 0}, folder):
        child = os.fork()
        if child == 0:
            os._exit(5)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 5
    assert not (folder.path / "failed.json").exists()
    with (
        pytest.raises(TrainingError, match=r"ended the process \(exit code 0\)"),
        _recorded_failures({"seed": 0}, folder),
    ):
        os._exit(0)
    assert os._exit is end_at_once
    assert "ended the process" in json.loads((folder.path / "failed.json").read_text())["message"]
