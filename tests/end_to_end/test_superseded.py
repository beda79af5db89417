"""A densifier is edited and one more seed is run: no table averages both versions, and one command forgets the old."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.end_to_end.conftest import SMALL, Run

pytestmark = pytest.mark.end_to_end

MINE = """
from dataclasses import dataclass
from gsbench.densify import ADC

@dataclass
class Mine(ADC):
    pass
"""
QUICK = ["train.iterations=20", "eval.lpips=[]", "eval.flip=false", "tracking=none"]
OWN = ["densify=adc", "densify._target_=mine.Mine", "allow_targets=[mine]", "densify.name=mine", "name=edited"]


def test_an_edited_densifier_is_never_averaged_with_what_it_was(gsbench: Run, tmp_path: Path) -> None:
    runs = {"GSBENCH_RUNS": str(tmp_path / "runs")}
    (tmp_path / "mine.py").write_text(MINE)
    done = gsbench("-m", *SMALL, *QUICK, *OWN, "seed=0,1", **runs)
    assert done.returncode == 0, done.stderr
    assert "superseded" not in gsbench("status", "edited", **runs).stdout
    (tmp_path / "mine.py").write_text(MINE + "# edited\n")
    assert "2 trials: 2 superseded" in gsbench("status", "edited", **runs).stdout
    done = gsbench(*SMALL, *QUICK, *OWN, "seed=2", **runs)
    assert done.returncode == 0, done.stderr

    table = gsbench("tables", "edited", **runs)
    assert table.returncode == 2
    assert "different versions of mine.Mine" in table.stderr
    assert "courtyard seeds 0, 1" in table.stderr
    listed = json.loads(gsbench("status", "edited", "--json", **runs).stdout)
    assert sorted((Path(trial["folder"]).name[-5:], trial["state"]) for trial in listed) == [
        ("seed0", "superseded"),
        ("seed1", "superseded"),
        ("seed2", "done"),
    ]
    forgotten = gsbench("status", "edited", "--forget-superseded", **runs)
    assert forgotten.returncode == 0, forgotten.stderr
    assert forgotten.stdout.count("removed /") == 2
    assert "mine.Mine was" in forgotten.stdout
    assert gsbench("status", "edited", **runs).stdout == "1 trial: 1 done\n"
    assert gsbench("tables", "edited", **runs).returncode == 0

    (tmp_path / "mine.py").write_text(MINE)  # the old code comes back: its trials are in the store
    again = gsbench("-m", *SMALL, *QUICK, *OWN, "seed=0,1", **runs)
    assert again.returncode == 0, again.stderr
    assert "iteration" not in again.stderr
    assert "3 trials: 2 done, 1 superseded" in gsbench("status", "edited", **runs).stdout
