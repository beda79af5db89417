"""Run the real program as a user does: in a subprocess, in an empty folder."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from gsbench.cli import run

Run = Callable[..., "subprocess.CompletedProcess[str]"]

# A whole trial in seconds: a small courtyard, its exact cameras, a random cloud, few iterations, nothing downloaded.
SMALL = [
    "scene=courtyard",
    "scene.views=12",
    "scene.width=96",
    "scene.height=72",
    "init=random",
    "init.count=3000",
    "init.size=1.2",
    "train.iterations=300",
    "train.position_steps=300",
    "train.densify_start=50",
    "train.densify_interval=50",
    "train.densify_stop=250",
    "train.opacity_reset_interval=1000",
    "train.checkpoint_every=100",
    "eval.download=false",
    "eval.lpips=[squeeze]",
]


@pytest.fixture(scope="session")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The environment of the program: no weights, its own runs folder, the shared cache of compiled kernels."""
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("GSBENCH_", "MLFLOW_"))}
    return kept | {
        "GSBENCH_RUNS": str(tmp_path_factory.mktemp("runs")),
        "TORCH_HOME": str(tmp_path_factory.mktemp("hub")),
    }


@pytest.fixture
def gsbench(environment: dict[str, str], tmp_path: Path) -> Run:
    """Call ``gsbench`` with arguments; returns the finished process with its output as text."""

    def run(*arguments: str, timeout: float = 240, **changes: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "gsbench.cli", *arguments],
            cwd=tmp_path,
            env=environment | changes,
            capture_output=True,
            text=True,
            timeout=timeout,
            check=False,
        )

    return run


def trial_of(settings: Sequence[str], runs: Path, capture: Path, *words: str) -> Path:
    """Run one trial of the capture in a folder within this process; returns the trial's folder."""
    assert run([*settings, f"scene.path={capture}", f"runs={runs}", f"name={capture.name}", *words]) == 0
    (folder,) = {path.parent for path in (runs / capture.name).glob("*/*/*/results.json")}
    return folder
