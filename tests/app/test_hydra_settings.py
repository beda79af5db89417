"""Hydra's own settings: what of them is read, and the advice of errors."""

from __future__ import annotations

from pathlib import Path

import pytest

from gsbench import cli
from gsbench.app.command import compose_trials
from gsbench.config.command_words import check_search_path
from gsbench.errors import InputError


@pytest.fixture(autouse=True)
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("GSBENCH_RUNS", str(tmp_path / "runs"))
    monkeypatch.chdir(tmp_path)
    return tmp_path / "runs"


SWEEP = ["densify=adc,none", "seed=0,1", "init=random", "tracking=none"]


def test_a_sweep_has_one_time() -> None:
    """Microseconds, so that two of them never agree by chance; each densifier is a composition of its own."""
    trials = compose_trials([*SWEEP, "name=x-${now:%H%M%S%f}", "scene.name=y-${now:%f}"], multirun=True)
    assert len({trial.values["name"] for trial in trials}) == 1
    assert len({trial.values["scene"]["name"] for trial in trials}) == 1


@pytest.mark.parametrize(
    "word",
    [
        "hydra.run.dir=elsewhere",
        "hydra.sweep.dir=elsewhere",
        "hydra.output_subdir=x",
        "+hydra.job.env_set.OMP_NUM_THREADS='1'",
    ],
)
def test_what_hydra_alone_would_read_is_refused(word: str) -> None:
    with pytest.raises(InputError, match=r"^hydra\."):
        compose_trials([*SWEEP, word], multirun=True)


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["name=x-${hydra:job.num}"], "so they cannot read Hydra's"),
        (["-m", "seed=0,1", "densify.name=a${hydra:job.id}"], "so they cannot read Hydra's"),
        (["hydra.verbose=true"], "log.txt in a trial's folder holds everything"),
        (["-m", "hydra/sweeper=basic", "seed=0,1"], "gsbench has its own"),
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
