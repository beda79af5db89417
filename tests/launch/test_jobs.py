"""The files of a trial say how its job ended; the result that the job returned is not read."""

import json
import logging
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from gsbench.config.compose import compose_one
from gsbench.errors import InputError
from gsbench.launch import jobs
from gsbench.launch.jobs import Outcome, clouds_first, collect, job_folder


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("GSBENCH_RUNS", str(tmp_path / "runs"))
    return tmp_path


def collected(folder: Path, failure: str | None = None) -> Outcome:
    """The outcome of a job that left a pickled result, which is not read, and perhaps a failure."""
    trial = compose_one(["name=x"])
    if failure is not None:
        trial.folder.mkdir(parents=True)
        (trial.folder / "failed.json").write_text(failure)
    (folder / "1_0_result.pkl").write_bytes(b"cos\nmkdir\n(S'exploded'\ntR.")
    (folder / "log").write_text("loading\nRuntimeError: no luck\n")
    paths = SimpleNamespace(result_pickle=folder / "1_0_result.pkl", stderr=folder / "log")
    job: Any = SimpleNamespace(paths=paths)
    return collect(job, trial.folder, [trial])


def test_a_failure_is_read_from_the_trials_folder(folder):
    outcome = collected(folder, json.dumps({"message": "no scene\nat all", "bad_input": True}))
    assert outcome.message == f"no scene; log: {folder / 'log'}"
    assert (outcome.status, outcome.bad_input) == ("failed", True)


def test_the_end_of_a_job_without_files_is_read_from_its_log(folder):
    outcome = collected(folder)
    assert outcome.status == "failed"
    assert "ended without a result" in outcome.message
    assert "its last lines: RuntimeError: no luck" in outcome.message


def test_one_trial_of_each_cloud_begins_first():
    def trial(scene, seed):
        return SimpleNamespace(values={"scene": scene, "init": "sfm", "seed": seed})

    trials = [trial(scene, seed) for scene in "ab" for seed in (0, 1)]
    assert [(t.values["scene"], t.values["seed"]) for t in clouds_first(trials)] == [
        *(("a", 0), ("b", 0)),
        *(("a", 1), ("b", 1)),
    ]


def test_submitits_link_is_removed_and_any_other_link_is_refused(tmp_path):
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


def test_waiting_ends_with_the_last_job_and_counts_jobs_that_left_the_queue(
    folder, monkeypatch, caplog
):
    """The first job wrote a result, the second is listed once more and then missing twice."""
    caplog.set_level(logging.INFO, "gsbench")
    queues = iter([{"7_1"}, None, set(), {"7_1"}, set(), set()])
    monkeypatch.setattr(jobs, "read_queue", lambda users: next(queues))
    monkeypatch.setattr(jobs, "SECONDS_BETWEEN_POLLS", 0)
    monkeypatch.setattr(jobs, "SECONDS_BETWEEN_QUEUE_CHECKS", -1)
    trials = [compose_one(["name=x", f"seed={seed}"]) for seed in (0, 1)]
    waiting = {}
    for number, trial in enumerate(trials):
        paths = SimpleNamespace(
            result_pickle=folder / f"{number}.pkl", stderr=folder / f"{number}.log"
        )
        waiting[trial.folder] = SimpleNamespace(job_id=f"7_{number}", paths=paths)
    (folder / "0.pkl").write_bytes(b"")
    outcomes = jobs._wait(waiting, trials)
    assert [outcome.folder for outcome in outcomes] == [trial.folder for trial in trials]
    assert list(queues) == []
    said = [record.getMessage() for record in caplog.records]
    assert ["seed 0" in said[0], "seed 1" in said[1]] == [True, True]
    assert [line.endswith(f"({k} of 2)") for k, line in enumerate(said, 1)] == [True, True]
