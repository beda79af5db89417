"""A trial's end, whatever its code does."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from gsbench.errors import TrainingError
from gsbench.pipeline.trial import _recorded_failures
from gsbench.runs.trial_files import TrialPaths


@pytest.mark.parametrize("code", [0, None, 3, "text"])
def test_code_that_ends_the_process_is_a_failure(code: int | str | None, tmp_path: Path) -> None:
    paths = TrialPaths(tmp_path, tmp_path / "x")
    paths.folder.mkdir()
    with pytest.raises(TrainingError, match="ended the process"), _recorded_failures({"seed": 0}, paths):
        sys.exit(code)
    assert "ended the process" in json.loads((paths.folder / "failed.json").read_text())["message"]
