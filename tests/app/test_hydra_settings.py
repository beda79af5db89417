"""Hydra's own settings: what of them is known when, where Hydra's files go, and the advice of errors."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

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
    trials = compose_trials([*SWEEP, "name=x-${now:%H%M%S%f}", "scene.name=y-${now:%f}"], multirun=True)
    assert len({trial.values["name"] for trial in trials}) == 1
    assert len({trial.values["scene"]["name"] for trial in trials}) == 1


@pytest.mark.usefixtures("no_trials")
def test_hydra_leaves_its_record_where_it_runs_the_jobs(tmp_path: Path) -> None:
    folders = ["hydra.sweep.dir=h/${now:%H%M%S%f}", "hydra.sweep.subdir=${hydra:job.num}"]
    words = ["-m", *SWEEP, "hydra/launcher=basic", *folders, "hydra.output_subdir=of_hydra"]
    assert cli.run([*words, "--dry-run"]) == 0
    assert not (tmp_path / "h").exists()
    assert cli.run(words) == 0
    (folder,) = (tmp_path / "h").iterdir()
    assert sorted(path.name for path in folder.iterdir()) == ["0", "1", "2", "3"]
    assert (folder / "3" / "of_hydra" / "config.yaml").is_file()


@pytest.mark.parametrize(
    "word",
    [
        "hydra.sweep.dir=elsewhere",
        "hydra.output_subdir=x",
        "+hydra.job.env_set.OMP_NUM_THREADS='1'",
        "+hydra.callbacks.log._target_=hydra.experimental.callbacks.LogJobReturnCallback",
    ],
)
def test_what_only_jobs_of_hydras_read_is_refused_without_them(word: str) -> None:
    with pytest.raises(InputError, match="add hydra/launcher=basic"):
        compose_trials([*SWEEP, word], multirun=True)
    assert compose_trials([*SWEEP, word, "hydra/launcher=basic"], multirun=True)


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["name=x-${hydra:job.num}"], "so they cannot read Hydra's"),
        (["-m", "seed=0,1", "densify.name=a${hydra:job.id}"], "so they cannot read Hydra's"),
        (["hydra.verbose=true"], "log.txt in a trial's folder holds everything"),
        (["-m", "hydra/sweeper=basic", "seed=0,1"], "gsbench's own alone"),
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
