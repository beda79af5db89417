"""Two small finished trials for the viewer to show."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.end_to_end.conftest import SMALL


@pytest.fixture(scope="session")
def small_runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A runs folder with the experiment ``small``: ADC and volumetric, one seed."""
    runs = tmp_path_factory.mktemp("view-runs")
    ours = ("GSBENCH_", "MLFLOW_")
    kept = {key: value for key, value in os.environ.items() if not key.startswith(ours)}
    changes = {"GSBENCH_RUNS": str(runs), "TORCH_HOME": str(tmp_path_factory.mktemp("hub"))}
    words = ["name=small", "densify=adc,volumetric", "tracking=none", "eval.flip=false"]
    command = [sys.executable, "-m", "gsbench.cli", "-m", *SMALL, *words]
    said = {"capture_output": True, "text": True}
    done = subprocess.run(command, cwd=runs, env=kept | changes, timeout=300, check=False, **said)
    assert done.returncode == 0, done.stderr
    return runs
