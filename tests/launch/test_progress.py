"""How far a sweep is, as ``gsbench status --watch`` and `progress_frame` show it."""

from pathlib import Path
from shlex import split
from types import SimpleNamespace

import pytest

from gsbench.cli import run
from gsbench.errors import InputError
from gsbench.launch.estimates import _seconds_left, progress_frame
from gsbench.launch.states import TrialState
from gsbench.system.locks import hold
from tests.helpers import write, write_lines
from tests.tracking.helpers import begin_trial, write_trial
from tests.trials import trial_values

ARMS, SEEDS = ("adc", "volumetric"), (0, 1, 2)


def begin(runs, arm, seed):
    return begin_trial(trial_values(runs, seed, "swept", densify=arm))


@pytest.fixture
def sweep(tmp_path):
    """A sweep: all trials of adc are done; of volumetric, one is done, one failed and one began."""
    folders = {(arm, seed): begin(tmp_path, arm, seed) for arm in ARMS for seed in SEEDS}
    psnr = {("adc", 0): 25.0, ("adc", 1): 10.0, ("adc", 2): 10.0, ("volumetric", 0): 20.0}
    for (arm, seed), value in psnr.items():
        values = trial_values(tmp_path, seed, "swept", densify=arm)
        write_trial(folders[arm, seed], values, psnr=value)
    write(folders["volumetric", 1] / "failed.json", {"message": "x"})
    return folders


def test_states_speed_and_time_left(sweep, tmp_path):
    running = sweep["volumetric", 2]
    building = tmp_path / "store/train/now"
    rows = [{"step": 50, "seconds": 5.0}, {"step": 75, "seconds": 10.0}]
    write_lines(building / "metrics.jsonl", rows)
    write(running / "building.json", {"stage": "train", "folder": str(building)})
    with hold(running / ".lock", "a trial"):
        frame = progress_frame(tmp_path, "swept")
    assert frame.loc["a_init-adc"].to_list() == [3, 0, 0, 0, 0]
    assert frame.loc["a_init-volumetric"].to_list() == [1, 1, 1, 0, pytest.approx(7.5)]
    # half of 150 iterations, of trials that take 2 s
    assert frame.attrs["seconds_left"] == pytest.approx(1.0)
    # no process runs it any more
    assert progress_frame(tmp_path, "swept").loc["a_init-volumetric"].to_list() == [1, 0, 1, 1, 0]


@pytest.mark.parametrize("planned", [False, True])
def test_an_arm_of_several_settings_is_named_with_their_values(tmp_path, planned):
    folders = [begin(tmp_path, "adc", seed) for seed in (0, 1)]
    values = trial_values(tmp_path, 0, "swept") | {"densify": {"name": "adc", "start": 5}}
    other = begin_trial(values)
    begin(tmp_path, "mcmc", 0)
    arms = [f"a_init-adc[{folder.name[:8]}]" for folder in (folders[0], other)]
    if planned:
        words = {folder: ["densify=adc", "seed=0"] for folder in folders}
        words |= {folder: [*own, "densify.start=7"] for folder, own in words.items()}
        words[other] = split("densify=adc seed=0 +densify.start=5")
        trials = {"/".join(place.parts[-3:]): {"words": own} for place, own in words.items()}
        command = {"words": [], "cwd": ".", "time": 0.0, "trials": trials}
        write_lines(tmp_path / "swept/commands.jsonl", [command])
        arms = ["a_init-adc[start=7]", "a_init-adc[start=5]"]
    frame = progress_frame(tmp_path, "swept")
    assert dict(frame["waiting"]) == {arms[0]: 2, arms[1]: 1, "a_init-mcmc": 1}
    assert frame.attrs["seconds_left"] is None


@pytest.mark.parametrize(
    "names, states, seconds",
    [
        ([("adc", "a")], ["missing"], 11),  # its arm and scene
        ([("adc", "b")], ["partial"], 21),
        ([("adc", "c")], ["missing"], 16),  # its arm: (11 + 21) / 2
        ([("mcmc", "a")], ["queued"], 24),  # all: (11 + 21 + 40) / 3
        ([("adc", "a"), ("adc", "b")], ["missing", "missing"], 32),
        ([("adc", "a"), ("adc", "b")], ["running", "running"], 16),  # two at once
        ([("adc", "a"), ("adc", "b")], ["running", "missing"], 32),
        ([("adc", "a"), ("adc", "b")], ["failed", "done"], 0),
    ],
)
def test_a_trial_takes_as_long_as_those_most_like_it(tmp_path, names, states, seconds):
    known = {("adc", "a"): 1.0, ("adc", "b"): 11.0, ("volumetric", "a"): 30.0}
    by_folder, done, waiting = {}, [], []
    for name, took in known.items():
        record = SimpleNamespace(seconds={"init": 10.0, "train": took})
        done.append(SimpleNamespace(path=Path(*name), record=record))
        by_folder[done[-1].path] = name
    for k, (name, state) in enumerate(zip(names, states, strict=True)):
        waiting.append(TrialState(tmp_path / str(k), state, None, ""))
        by_folder[waiting[-1].folder] = name
    assert _seconds_left(waiting, by_folder, done) == pytest.approx(seconds)


def test_a_training_without_a_time_has_no_speed(sweep, tmp_path):
    running = sweep["volumetric", 2]
    write(running / "building.json", {"folder": str(running)})
    for rows in ("", '{"step": 75}\n', '{"step": 75, "seconds": 0}\n'):
        (running / "metrics.jsonl").write_text(rows)
        with hold(running / ".lock", "a trial"):
            frame = progress_frame(tmp_path, "swept")
        assert frame.loc["a_init-volumetric", "iterations_per_second"] == 0
        assert frame.attrs["seconds_left"] == pytest.approx(1.0 if rows else 2.0)


def test_watch_prints_the_table_and_ends_once_all_trials_have_ended(
    sweep, tmp_path, monkeypatch, capsys
):
    write(sweep["volumetric", 2] / "failed.json", {"message": "x"})
    monkeypatch.setenv("GSBENCH_RUNS", str(tmp_path))
    assert run(split("status swept --watch")) == 1
    lines = capsys.readouterr().out.replace("│", " ").splitlines()
    assert ["a_init-volumetric", "1", "0", "2", "0", "0"] in [line.split() for line in lines]


@pytest.mark.parametrize("words", [["status", "--watch"], split("status nothing --watch")])
def test_watching_no_experiment_is_refused_in_one_line(words, tmp_path, monkeypatch, refused):
    monkeypatch.setenv("GSBENCH_RUNS", str(tmp_path))
    refused(*words)
    with pytest.raises(InputError):
        progress_frame(tmp_path, "nothing")
