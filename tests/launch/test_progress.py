"""How far a sweep is, as ``gsbench status --watch`` and `progress_frame` show it."""

import json
from pathlib import Path

import pytest

from gsbench.cli import run
from gsbench.errors import InputError
from gsbench.launch.progress import progress_frame, progress_of
from gsbench.runs.trial_folder import TrialFolder
from gsbench.system.locks import hold
from tests.tracking.helpers import begin_trial, trial_values, write_trial

ARMS, SEEDS = ("adc", "volumetric"), (0, 1, 2)


def begin(runs: Path, arm: str, seed: int) -> Path:
    values = trial_values(runs, seed, "swept") | {"densify": {"name": arm}}
    return begin_trial(values)


@pytest.fixture
def sweep(tmp_path) -> dict[tuple[str, int], Path]:
    """A sweep: all trials of adc are done; of volumetric, one is done, one failed and one began."""
    folders = {(arm, seed): begin(tmp_path, arm, seed) for arm in ARMS for seed in SEEDS}
    # In the only seed that both have, adc is better; in the mean over all of its own trials it is
    # worse.
    psnr = {("adc", 0): 25.0, ("adc", 1): 10.0, ("adc", 2): 10.0, ("volumetric", 0): 20.0}
    for (arm, seed), value in psnr.items():
        write_trial(
            folders[arm, seed],
            trial_values(tmp_path, seed, "swept") | {"densify": {"name": arm}},
            psnr=value,
        )
    (folders["volumetric", 1] / "failed.json").write_text(json.dumps({"message": "x"}))
    return folders


def test_states_speed_time_left_and_leader(sweep, tmp_path):
    running = sweep["volumetric", 2]
    building = tmp_path / "store" / "train" / "now"
    building.mkdir(parents=True)
    (building / "metrics.jsonl").write_text(
        '{"step": 50, "seconds": 5.0}\n{"step": 75, "seconds": 10.0}\n'
    )
    (running / "building.json").write_text(json.dumps({"stage": "train", "folder": str(building)}))
    with hold(running / ".lock", "a trial"):
        frame = progress_frame(tmp_path, "swept").set_index("arm")
    assert frame.loc["a_init-adc", ["done", "running", "failed", "waiting"]].to_list() == [
        3,
        0,
        0,
        0,
    ]
    assert frame.loc["a_init-volumetric", ["done", "running", "failed", "waiting"]].to_list() == [
        1,
        1,
        1,
        0,
    ]
    assert frame.loc["a_init-volumetric", "iterations_per_second"] == pytest.approx(7.5)
    # half of 150 iterations, of trials that take 2 s
    assert frame.attrs["seconds_left"] == pytest.approx(1.0)
    assert frame.attrs["leader"].startswith(
        "a_init-adc leads so far: PSNR (dB) 25.00, mean of the 1 "
    )
    assert "not a verdict" in frame.attrs["leader"]


def test_a_trial_that_no_process_runs_counts_as_waiting(sweep):
    home = TrialFolder(sweep["adc", 0]).home
    progress = progress_of(home)
    assert progress.cells["a_init-volumetric", "a_scene"] == {
        "done": 1,
        "running": 0,
        "failed": 1,
        "waiting": 1,
    }
    assert not progress.has_ended
    assert progress.speeds == {}


def test_no_arm_leads_before_all_arms_share_a_seed(tmp_path):
    for arm in ARMS:
        begin(tmp_path, arm, 0)
    progress = progress_of(tmp_path / "swept")
    assert (progress.leader, progress.seconds_left) == ("", None)


def test_watch_prints_the_table_and_ends_once_all_trials_have_ended(
    sweep, tmp_path, monkeypatch, capsys
):
    (sweep["volumetric", 2] / "failed.json").write_text(json.dumps({"message": "x"}))
    monkeypatch.setenv("GSBENCH_RUNS", str(tmp_path))
    assert run(["status", "swept", "--watch"]) == 1
    said = capsys.readouterr().out
    assert "3/3" in said
    assert "1/3, 2 failed" in said
    assert "not a verdict" in " ".join(said.split())


@pytest.mark.parametrize("words", [["status", "--watch"], ["status", "nothing", "--watch"]])
def test_watching_no_experiment_is_refused_in_one_line(words, tmp_path, monkeypatch, refused):
    monkeypatch.setenv("GSBENCH_RUNS", str(tmp_path))
    refused(*words)
    with pytest.raises(InputError):
        progress_frame(tmp_path, "nothing")
