"""A finished trial's files are held against what was written down of them, and what was changed is named."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from gsbench import cli
from gsbench.analysis.results import load_experiment, read_views
from gsbench.errors import InputError
from gsbench.launch.states import states_of_experiment
from gsbench.runs.trial_folder import TrialFolder
from tests.fuzz.records import EXPERIMENT, write_trial


@pytest.fixture
def trial(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("GSBENCH_RUNS", str(tmp_path))
    write_trial(tmp_path, "adc", 1)
    return write_trial(tmp_path, "adc", 0)


def edit(path: Path, old: str, new: str) -> None:
    """Change a file and keep its time, as somebody might who wants no one to see it."""
    state = path.stat()
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    os.utime(path, ns=(state.st_atime_ns, state.st_mtime_ns))


def test_changed_results_are_left_out_and_named(trial: Path, capsys: pytest.CaptureFixture[str]) -> None:
    edit(trial / "results.json", "26.5", "43.2")
    experiment = load_experiment(trial.parents[3], EXPERIMENT)
    assert [one.seed for one in experiment.trials] == [1]
    (line,) = experiment.warnings
    assert "results.json was changed after it was written" in line
    assert f"gsbench retry {EXPERIMENT}" in line
    assert TrialFolder(trial).state() == "damaged"
    assert cli.run(["tables", EXPERIMENT]) == 0
    said = capsys.readouterr()
    assert "43.2" not in said.out
    assert f"left out: {line}" in said.err
    assert cli.run(["status", EXPERIMENT]) == 1
    shown = capsys.readouterr().out
    assert "damaged" in shown
    assert "results.json was changed after it was written" in shown
    assert "2 trials: 1 done, 1 damaged" in shown


def test_other_spaces_and_another_time_are_no_change(trial: Path) -> None:
    path = trial / "results.json"
    path.write_text(json.dumps(json.loads(path.read_text())))
    os.utime(path, (1, 1))
    assert TrialFolder(trial).record().metrics == {"psnr": 26.5}
    assert TrialFolder(trial).state() == "done"


def test_results_without_a_record_of_them_are_believed(trial: Path) -> None:
    path = trial / "results.json"
    content = json.loads(path.read_text())
    del content["made_of"]
    path.write_text(json.dumps(content))
    edit(trial / "results.json", "26.5", "43.2")
    assert TrialFolder(trial).record().metrics == {"psnr": 43.2}


def test_changed_views_and_curves_are_not_used(trial: Path, caplog: pytest.LogCaptureFixture) -> None:
    edit(trial / "per_view.csv", "a,25.5\nb,27.5", "a,24.5\nb,28.5")  # the mean is as it was
    edit(trial / "metrics.jsonl", "20.2", "40.2")
    (one,) = (one for one in load_experiment(trial.parents[3], EXPERIMENT).trials if one.path == trial)
    with pytest.raises(InputError, match=r"per_view\.csv was changed after it was written"):
        read_views(one)
    assert one.folder.curves() == []
    assert "metrics.jsonl was changed after it was written" in caplog.text
    assert len(one.folder.events()) == 10


def test_settings_are_those_that_the_results_were_made_by(trial: Path) -> None:
    """A configuration that is edited afterwards does not make the trial another one."""
    edit(trial / "config.yaml", '"volume_threshold": 0.03', '"volume_threshold": 0.04')
    for one in load_experiment(trial.parents[3], EXPERIMENT).trials:
        assert one.config["densify.volume_threshold"] == 0.03


def test_a_failed_trial_leaves_when_its_class_was_mended(trial: Path) -> None:
    """Equal settings under another hash: a class was edited meanwhile, and the later trial is done."""
    old = trial.with_name(f"0ld0ld00-{trial.name.partition('-')[2]}")
    old.mkdir()
    (old / "config.yaml").write_text((trial / "config.yaml").read_text())
    (old / "failed.json").write_text(json.dumps({"error": "TypeError", "message": "mine.Mine has no x"}))
    found = {one.folder: one for one in states_of_experiment(trial.parents[2])}
    assert found[old].state == "superseded"
    assert f"{trial.name} is done, made by later code: mine.Mine has no x" in found[old].note
    edit(old / "config.yaml", '"volume_threshold": 0.03', '"volume_threshold": 0.04')  # other settings: still missing
    assert {one.folder: one.state for one in states_of_experiment(trial.parents[2])}[old] == "failed"
    edit(old / "config.yaml", '"volume_threshold": 0.04', '"volume_threshold": 0.03')
    (trial / "results.json").unlink()  # nothing has taken its place
    assert {one.folder: one.state for one in states_of_experiment(trial.parents[2])}[old] == "failed"
