"""Several grids in one experiment: the trials that they make, and plan, dry run and retry."""

from shlex import split

import pytest

from gsbench import cli
from gsbench.app.command import compose_trials
from gsbench.app.grids import checked_grids, words_of_grids
from gsbench.config.compose import compose_one
from gsbench.launch.record import record
from gsbench.runs.commands import read_history
from gsbench.runs.trial_folder import TrialFolder
from tests.helpers import refusal, write
from tests.trials import write_results

# Some trials of `threshold` by their names, which stay as they are from version to version.
KNOWN = {
    "sfm-volumetric-0.001/7073da94-seed0",
    "sfm-volumetric-0.003/fce528af-seed1",
    "sfm-volumetric-0.01/12dd6a9a-seed2",
    "sfm-volumetric-0.03/6aec03c5-seed0",
    "sfm-volumetric-0.1/ac702be4-seed1",
    "sfm-volumetric-0.3/2c2802d0-seed2",
}


pytestmark = pytest.mark.usefixtures("runs")


def arms(*words):
    """Densifier and seed of each trial, in order."""
    return [made(trial) for trial in compose_trials(words)]


def made(trial):
    return trial.values["densify"]["name"], trial.values["seed"]


def test_each_grid_gets_its_own_the_shared_and_the_typed_words():
    grids = [
        {"densify": "adc"},
        {"densify": "volumetric", "densify.volume_threshold": "1,2", "seed": "7"},
    ]
    given = split("train=quick densify.volume_threshold=3 +experiment=x")
    assert words_of_grids({"seed": "0,1"}, grids, given) == [
        split("densify=adc seed=0,1 train=quick +experiment=x"),
        ["densify=volumetric", "densify.volume_threshold=1,2", "seed=7", *given],
    ]
    assert words_of_grids({"seed": "0,1"}, [], given) == [["seed=0,1", *given]]


@pytest.mark.parametrize("grids", ["x", [1], [{}], {"a": 1}])
def test_grids_are_a_list_of_mappings(grids):
    with refusal(r"grids must be a list, each a mapping"):
        checked_grids(grids)
    found = checked_grids([{"a": 1, "b": True}, {"c": "1,2"}])
    assert found == [{"a": "1", "b": "true"}, {"c": "1,2"}]
    for value in (None, [1], {"a": 1}):
        with refusal("grids: a must list values"):
            checked_grids([{"a": value}])


def test_a_baseline_without_the_setting_is_compared_with_arms_that_have_it():
    # `single` was the default when these trials ran
    trials = compose_trials(["+experiment=threshold", "init.camera=single"])
    places = ["/".join(TrialFolder.of(trial.values).path.parts[-2:]) for trial in trials]
    assert len(places) == len(set(places)) == 21
    assert set(places) > KNOWN  # results from before are found again
    names = [place.split("/")[0] for place in places]
    assert names[:4] == 3 * ["sfm-adc"] + ["sfm-volumetric-0.001"]
    assert "volume_threshold" not in trials[0].values["densify"]
    for trial in (trials[0], trials[-1]):
        assert compose_one(trial.overrides).values == trial.values  # as `retry` composes it


def test_a_typed_setting_reaches_every_grid_that_has_it():
    own = arms("+experiment=threshold", "densify.volume_threshold=0.5,0.7", "seed=4")
    assert own == [("adc", 4), ("volumetric-0.5", 4), ("volumetric-0.7", 4)]
    words = split("+experiment=threshold seed=4 densify.max_gaussians=5000 train.iterations=7")
    for trial in compose_trials(words):
        assert trial.values["densify"]["max_gaussians"] == 5000
        assert trial.values["train"]["iterations"] == 7
    with refusal(r"densify\.volume_threshold is not a setting"):
        arms("+experiment=threshold", "densify=mcmc")


def test_a_setting_that_one_arm_lacks_is_answered_by_the_grids_that_work():
    words = ["densify=adc,mcmc,volumetric", "densify.volume_threshold=0.01,0.03"]
    with refusal(r"^densify\.volume_threshold is not a setting.* own settings, as '") as caught:
        compose_trials([*words, "seed=4"], multirun=True)
    grids = str(caught.value).rpartition(" as ")[2].strip("'")
    names = [made(trial)[0] for trial in compose_trials([grids, "seed=4"], multirun=True)]
    assert names == split("adc volumetric volumetric")


def test_grids_in_a_users_own_experiment(tmp_path):
    words = [f"hydra.searchpath=[file://{tmp_path}/own]", "+experiment=mine"]

    def join(grids):
        head = "# @package _global_\nname: mine\nhydra:\n  mode: MULTIRUN\n  sweeper:\n    grids: "
        write(tmp_path / "own/experiment/mine.yaml", f"{head}{grids}\n")

    join('[{densify: adc, seed: "0,1"}, {densify: none, train.iterations: 0}, {eval.flip: false}]')
    assert arms(*words) == [("adc", 0), ("adc", 1), ("none", 0), ("volumetric", 0)]
    for wrong in ("[densify]", "[{}]", "[{seed: [0, 1]}]"):
        join(wrong)
        with refusal(r"^hydra\.sweeper\.grids"):
            arms(*words)


def test_plan_dry_run_and_retry_see_one_experiment(runs, monkeypatch, capsys, said):
    words = split("+experiment=threshold densify.volume_threshold=0.5 seed=0")
    assert "2 trials: 2 missing" in said(*words, "--dry-run")
    trials = compose_trials(words)
    record(trials, asks=False)
    first, second = (TrialFolder.of(trial.values).path for trial in trials)
    assert list(read_history(runs / "threshold").planned) == [first, second]
    write(first / "config.yaml", trials[0].yaml)
    write_results(first, trials[0].values)
    ran = []

    def run_trials(again):
        ran.extend(TrialFolder.of(trial.values).path for trial in again)
        return 0

    monkeypatch.setattr("gsbench.app.command.run_trials", run_trials)
    assert cli.run(["status", "threshold"]) == 1
    assert "2 trials: 1 done, 1 missing" in capsys.readouterr().out
    assert cli.run(["retry", "threshold"]) == 0
    assert ran == [second]


def test_a_setting_that_a_files_grid_adds_is_given_without_a_plus(tmp_path, monkeypatch):
    """The file's class has it, and the choices of the command line do not."""
    monkeypatch.chdir(tmp_path)
    mine = "from dataclasses import dataclass\nfrom gsbench.densify import ADC\n"
    write(tmp_path / "mine.py", f"{mine}@dataclass\nclass Mine(ADC):\n    decay: float = 0.5\n")
    grid = "{densify: adc, densify._target_: mine.Mine, densify.name: mine, +densify.decay: '.7'}"
    node = f"hydra: {{mode: MULTIRUN, sweeper: {{grids: [{{densify: volumetric}}, {grid}]}}}}\n"
    write(tmp_path / "conf/experiment/e.yaml", f"# @package _global_\n{node}")
    words = ["hydra.searchpath=[conf]", "+experiment=e", "allow_targets=[mine]"]
    for typed, decays in (([], [0.7]), (["=0.1"], [0.1]), (["=0.1,0.2"], [0.1, 0.2])):
        given = [f"densify.decay{value}" for value in typed]
        trials = compose_trials([*words, *given], multirun=True)
        found = [trial.values["densify"].get("decay") for trial in trials]
        assert found == [None, *decays]
