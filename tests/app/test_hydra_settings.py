"""Hydra's own settings: what of them is known when, where Hydra's files go, and the advice of errors."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

from gsbench import cli
from gsbench.app.command import compose_trials
from gsbench.config.command_words import check_search_path
from gsbench.errors import InputError
from gsbench.launch import serial


@pytest.fixture(autouse=True)
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("GSBENCH_RUNS", str(tmp_path / "runs"))
    monkeypatch.chdir(tmp_path)
    return tmp_path / "runs"


@pytest.fixture
def no_trials(monkeypatch: pytest.MonkeyPatch) -> None:
    def run(trial: Any, mirror: Any, wait: bool) -> SimpleNamespace:
        return SimpleNamespace(metrics={"psnr": 1.0})

    monkeypatch.setattr(serial, "_run", run)


SWEEP = ["densify=adc,none", "seed=0,1", "init=random", "tracking=none"]


def test_a_sweep_has_one_time() -> None:
    """Microseconds, so that two of them never agree by chance; each densifier is a composition of its own."""
    trials = compose_trials([*SWEEP, "name=x-${now:%H%M%S%f}", "hydra.sweep.dir=h/${now:%f}"], multirun=True)
    assert len({trial.values["name"] for trial in trials}) == 1
    assert len({trial.job.composed().hydra.sweep.dir for trial in trials if trial.job is not None}) == 1


@pytest.mark.usefixtures("no_trials")
def test_a_sweep_leaves_hydras_record_in_a_folder_that_was_asked_for(tmp_path: Path) -> None:
    folders = ["hydra.sweep.dir=h/${now:%H%M%S%f}", "hydra.sweep.subdir=${hydra:job.num}"]
    assert cli.run(["-m", *SWEEP, *folders, "--dry-run"]) == 0
    assert not (tmp_path / "h").exists()
    assert cli.run(["-m", *SWEEP, *folders]) == 0
    (folder,) = (tmp_path / "h").iterdir()
    assert sorted(path.name for path in folder.iterdir()) == ["0", "1", "2", "3", "multirun.yaml"]
    assert yaml.safe_load((folder / "multirun.yaml").read_text())["hydra"]["overrides"]["task"] == SWEEP


@pytest.mark.usefixtures("no_trials")
def test_else_there_is_no_record_of_hydras(runs: Path) -> None:
    assert cli.run(["-m", *SWEEP]) == 0
    assert not [*runs.rglob("multirun.yaml")]


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["name=x-${hydra:job.num}"], "${hydra:job.num}: a job has it only in a sweep: add -m"),
        (["densify.name=a${hydra:job.id}"], "${hydra:job.id}: a job has it only in a sweep: add -m"),
        (["name=${hydra:runtime.output_dir}"], "${hydra:runtime.output_dir}: it is known in a job only"),
        (["-m", "seed=0,1", "name=x-${hydra:runtime.output_dir}"], "it is known in a job only"),
        (["-m", "densify=glob([av]*)"], """'densify=glob("[av]*")'"""),
        (["-m", "densify=choice([av,b)"], "is not a setting like key=value"),
        (["-m", "hydra/launcher=joblib", "seed=0,1", "hydra.launcher.jobs=3"], "n_jobs"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_what_cannot_be_is_refused_in_a_line(words: list[str], text: str, capsys: pytest.CaptureFixture[str]) -> None:
    if "hydra/launcher=joblib" in words:
        pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    assert cli.run([*words, "--dry-run"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert text in line


def test_a_glob_of_characters_works_as_it_is_advised(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["-m", 'densify=glob("[av]*")', "--dry-run"]) == 0
    assert "sfm-adc" in capsys.readouterr().out


def test_a_job_of_a_sweep_has_a_number() -> None:
    trials = compose_trials(["seed=0,1", "name=x-${hydra:job.num}"], multirun=True)
    assert [trial.values["name"] for trial in trials] == ["x-0", "x-1"]


@pytest.mark.parametrize("words", [["--config-dir", "own", "--help"], ["-h", "--config-dir=own"], ["-m", "--help"]])
def test_help_is_given_wherever_it_is_asked_for(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "own" / "densify").mkdir(parents=True)
    (tmp_path / "own" / "densify" / "patient.yaml").write_text("defaults: [adc]\n")
    assert cli.run(words) == 0
    out = capsys.readouterr().out
    assert "Verbs" in out
    assert ("patient" in out) == any("own" in word for word in words)  # a folder's own choices are listed
    assert cli.run(["--config-dir", "nowhere", "--help"]) == 2


@pytest.mark.parametrize(
    "word",
    [
        "hydra.searchpath=[pkg://strange]",
        "hydra[searchpath]=[pkg://strange]",
        "hydra.searchpath=extend_list(pkg://strange)",
        "hydra[searchpath]=extend_list('pkg://strange')",
    ],
)
def test_no_package_is_searched_however_it_is_written(word: str) -> None:
    with pytest.raises(InputError):
        check_search_path([word], [])
