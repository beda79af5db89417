"""After an edit of a densifier's helper, tables show the newest code and name the older trials."""

import json
import os
import shutil
from pathlib import Path
from shlex import split

import pytest

from gsbench.cli import run
from tests.end_to_end.conftest import SMALL

pytestmark = pytest.mark.slow

MINE = """
from dataclasses import dataclass
from gsbench.densify import ADC

@dataclass
class Mine(ADC):
    def begin(self, *given, **named):
        from helper import said

        super().begin(*given, **named)
"""
HELPER = "said = 1\n"
QUICK = split("train.iterations=20 eval.lpips=[] eval.flip=false tracking=none")
OWN = split(
    "densify=adc densify._target_=mine.Mine allow_targets=[mine,helper] densify.name=mine "
    "name=edited"
)


def test_trials_of_an_edited_densifier_are_not_averaged_with_earlier_ones(
    gsbench, tmp_path, monkeypatch, capsys
):
    monkeypatch.setenv("GSBENCH_RUNS", str(tmp_path / "runs"))

    def train(seeds):
        """Train in a new process, which imports the present files."""
        return gsbench("-m", *SMALL, *QUICK, *OWN, f"seed={seeds}").stderr

    def ask(words):
        """Run a verb in this process, since verbs only read files."""
        assert run(words.split()) == 0
        return "".join(capsys.readouterr())

    (tmp_path / "mine.py").write_text(MINE)
    (tmp_path / "helper.py").write_text(HELPER)
    train("0,1")
    assert ask("status edited") == "2 trials: 2 done\n"
    (tmp_path / "unrelated.py").write_text("# new\n")
    assert ask("status edited") == "2 trials: 2 done\n"
    (tmp_path / "helper.py").write_text(f"# a comment\n{HELPER}")
    assert ask("status edited") == "2 trials: 2 done\n"
    assert "iteration" not in train("0,1")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "helper.py").write_text("said = 2\n")
    assert ask("status edited") == "2 trials: 2 done\n"  # as tables count them
    shown = ask("tables edited")
    assert "earlier versions" not in shown  # there are no newer ones
    train(2)

    shown = ask("tables edited")
    assert "edited: 2 trials of random-mine made by earlier versions of helper: " in shown
    # a copy without its times, where the module is not: the same version counts
    copied = shutil.copytree(tmp_path / "runs", tmp_path / "elsewhere" / "runs")
    for trial in copied.glob("edited/*/*/*/results.json"):
        os.utime(trial, (9e9, 9e9) if trial.parent.name.endswith(("0", "1")) else (1, 1))
    there = gsbench("tables edited", cwd=copied.parent, GSBENCH_RUNS=str(copied)).stdout
    assert there == shown.partition("left out: ")[0]
    listed = json.loads(ask("status edited --json"))
    states = {Path(trial["folder"]).name.partition("-")[2]: trial["state"] for trial in listed}
    assert states == {"seed0": "superseded", "seed1": "superseded", "seed2": "done"}
    forgotten = ask("status edited --forget-superseded")
    assert forgotten.count("removed /") == 2
    assert "made by earlier code" in forgotten
    assert ask("status edited") == "1 trial: 1 done\n"
    ask("tables edited")

    # the old code comes back: its trials are in the store
    (tmp_path / "helper.py").write_text(HELPER)
    assert "iteration" not in train("0,1")
    assert "3 trials: 2 done, 1 superseded" in ask("status edited")

    (folder,) = (tmp_path / "runs/edited").glob("*/*/*-seed0")
    shutil.rmtree(folder)
    again = gsbench("retry edited allow_targets=[mine,helper]")
    assert "configuration has changed" not in again.stderr
    assert folder.is_dir()
