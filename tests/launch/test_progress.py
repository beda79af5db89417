"""How far a sweep is, as ``gsbench status --watch`` and `progress_frame` show it."""

from shlex import split

import pytest

from gsbench.cli import run
from gsbench.errors import InputError
from gsbench.launch.states import progress_frame
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


def test_the_states_of_each_arm(sweep, tmp_path):
    with hold(sweep["volumetric", 2] / ".lock", "a trial"):
        frame = progress_frame(tmp_path, "swept")
    assert frame.loc["a_init-adc"].to_list() == [3, 0, 0, 0]
    assert frame.loc["a_init-volumetric"].to_list() == [1, 1, 1, 0]
    # no process runs it any more
    assert progress_frame(tmp_path, "swept").loc["a_init-volumetric"].to_list() == [1, 0, 1, 1]


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


def test_watch_prints_the_table_and_ends_once_all_trials_have_ended(
    sweep, tmp_path, monkeypatch, capsys
):
    write(sweep["volumetric", 2] / "failed.json", {"message": "x"})
    monkeypatch.setenv("GSBENCH_RUNS", str(tmp_path))
    assert run(split("status swept --watch")) == 1
    lines = capsys.readouterr().out.replace("│", " ").splitlines()
    assert ["a_init-volumetric", "1", "0", "2", "0"] in [line.split() for line in lines]


@pytest.mark.parametrize("words", [["status", "--watch"], split("status nothing --watch")])
def test_watching_no_experiment_is_refused_in_one_line(words, tmp_path, monkeypatch, refused):
    monkeypatch.setenv("GSBENCH_RUNS", str(tmp_path))
    refused(*words)
    with pytest.raises(InputError):
        progress_frame(tmp_path, "nothing")
