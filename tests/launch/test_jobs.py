"""What a job returned is read from a file of the runs folder, and nothing that such a file names is run."""

from __future__ import annotations

import os
import pickle
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from gsbench.config.compose import compose_one
from gsbench.errors import InputError
from gsbench.launch.jobs import clouds_first, collect, job_folder
from gsbench.launch.serial import Outcome


class Bomb:
    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.mark),)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("GSBENCH_RUNS", str(tmp_path / "runs"))
    return tmp_path


def collected(folder: Path, returned: Any) -> Outcome:
    trial = compose_one(["name=x"])
    result = folder / "1_0_result.pkl"
    result.write_bytes(pickle.dumps(returned))
    job: Any = SimpleNamespace(paths=SimpleNamespace(result_pickle=result, stderr=folder / "log"))
    return collect(job, trial.folder, [trial])


def test_an_outcome_comes_back(folder: Path) -> None:
    outcome = Outcome(folder / "trial", "failed", "no luck", bad_input=True)
    assert collected(folder, ("success", outcome)) == outcome


def test_an_error_is_its_last_line(folder: Path) -> None:
    outcome = collected(folder, ("error", "Traceback\nRuntimeError: no luck"))
    assert (outcome.status, outcome.message) == ("failed", f"RuntimeError: no luck; log: {folder / 'log'}")


@pytest.mark.parametrize("wrap", [lambda bomb: bomb, lambda bomb: ("success", bomb), lambda bomb: ("error", [bomb])])
def test_nothing_is_run(folder: Path, wrap: Any) -> None:
    outcome = collected(folder, wrap(Bomb(folder / "exploded")))
    assert outcome.status == "failed"
    assert "cannot be read" in outcome.message
    assert not (folder / "exploded").exists()


@pytest.mark.parametrize("content", [b"", b"no pickle", b"\x80\x05."])
def test_what_cannot_be_read_is_said(folder: Path, content: bytes) -> None:
    trial = compose_one(["name=x"])
    (folder / "r.pkl").write_bytes(content)
    job: Any = SimpleNamespace(paths=SimpleNamespace(result_pickle=folder / "r.pkl", stderr=folder / "log"))
    outcome = collect(job, trial.folder, [trial])
    assert "cannot be read" in outcome.message


def test_one_trial_of_each_cloud_begins_first() -> None:
    def trial(scene: str, seed: int) -> Any:
        return SimpleNamespace(values={"scene": scene, "init": "sfm", "seed": seed})

    trials = [trial(scene, seed) for scene in "ab" for seed in (0, 1)]
    assert [(t.values["scene"], t.values["seed"]) for t in clouds_first(trials)] == [
        *(("a", 0), ("b", 0)),
        *(("a", 1), ("b", 1)),
    ]


def test_a_link_of_submitits_does_not_refuse_the_next_submission_and_any_other_does(tmp_path: Path) -> None:
    values = compose_one(["name=cluster", f"runs={tmp_path}"]).values
    folder = job_folder(values)
    script = folder / "2_submission.sh"
    script.write_text("#!/bin/bash\n")
    left = folder / ".submission_file_aaa46bf3.sh"
    left.symlink_to(script)
    assert job_folder(values) == folder
    assert not left.is_symlink()
    assert script.exists()
    (folder / "2_0_0_log.out").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InputError, match=r"2_0_0_log\.out is a link"):
        job_folder(values)
