"""A tuned sweep through the real program: killed while it tunes, it goes on, and the sheet says what was chosen."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.end_to_end.conftest import SMALL, Run

pytestmark = pytest.mark.slow

pytest.importorskip("optuna", reason="needs Optuna (extra search)")

TUNED = [
    *("+experiment=tuned", "densify=adc,volumetric", "seed=0", *SMALL, "train.iterations=120", "eval.lpips=[]"),
    *("tracking=none", "hydra.sweeper.tune.points=2", "name=small"),
]


def views(arm: Path) -> set[str]:
    """The views that judge the trials of an arm."""
    return {line.split(",")[0] for file in arm.glob("*/per_view.csv") for line in file.read_text().splitlines()[1:]}


def test_a_killed_tuning_goes_on_and_its_values_are_trained(
    gsbench: Run, environment: dict[str, str], tmp_path: Path
) -> None:
    program = [sys.executable, "-m", "gsbench.cli", *TUNED]
    with subprocess.Popen(program, cwd=tmp_path, env=environment, stderr=subprocess.PIPE, text=True) as first:
        assert first.stderr is not None
        for line in first.stderr:
            if "point 1 of 2" in line:
                first.send_signal(signal.SIGKILL)
                break
        first.stderr.read()
    home = Path(environment["GSBENCH_RUNS"]) / "small"
    assert not (home / "tuning.json").exists()

    done = gsbench(*TUNED, "launch=local", "launch.parallel=2")  # by another launcher, too
    assert done.returncode == 0, done.stderr
    assert "trials done; the table: gsbench tables small\n" in done.stderr
    record = json.loads((home / "tuning.json").read_text())
    for arm, tuned in record["arms"].items():
        assert [point["state"] for point in tuned["search"]["points"]] == ["done", "done"]
        best = max(tuned["search"]["points"], key=lambda point: point["value"])
        (results,) = home.glob(f"courtyard/{arm}/*/inputs.json")
        text = results.read_text()
        assert all(str(value) in text for value in best["settings"].values())
        assert views(home / "courtyard" / arm)
        assert not views(home / "courtyard" / arm) & views(home.parent / f"small-tune-{arm}" / "courtyard" / arm)

    sheet = gsbench("tables", "small", "--layout", "fairness")
    assert sheet.stdout.count("is the best of 2 points by psnr of validation views") == 2
    assert "tuning was unequal" not in sheet.stdout
