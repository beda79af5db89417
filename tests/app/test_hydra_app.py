"""Hydra's path: real sweepers and launchers of Hydra's, with stand-ins for trainings."""

import copy
import os
import pickle
from shlex import split
from types import SimpleNamespace

import pytest
from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from gsbench.app import command, hydra_app, hydra_main, sweep
from gsbench.app.hydra_app import Goal, Job, goal_of, words_without_sweeper
from gsbench.app.hydra_main import words_for_files, words_for_new_folder
from gsbench.errors import GsbenchError, InputError
from gsbench.launch.jobs import Outcome
from tests.app.stand_ins import done, trial
from tests.helpers import refusal, table
from tests.trials import write_results

GRID = "hydra._internal.core_plugins.basic_sweeper.BasicSweeper"


class Trials(list):
    """Trials that ran, and whether their commands asked questions."""

    def __init__(self):
        super().__init__()
        self.asks = set()


QUICK = split("-m init=random tracking=none name=x")


@pytest.fixture
def ran(runs, monkeypatch):
    """The trials that commands run; each gets a result, or fails if its seed is 13."""
    ran = Trials()

    def run(trials, asks=True):
        outcomes = []
        for one in trials:
            ran.append(one)
            ran.asks.add(asks)
            psnr = 20.0 + one.values["seed"] + one.values["densify"].get("interval", 0) / 100
            write_results(one.folder, one.values, metrics={"psnr": psnr, "lpips_vgg": 1 / psnr})
            failed = one.values["seed"] == 13
            outcomes.append(Outcome(one.folder, "failed" if failed else "done", "no luck", True))
        return outcomes[::-1]

    monkeypatch.setattr(command, "run_batch", run)
    monkeypatch.setattr(hydra_app, "begin", lambda trials, asks: None)
    return ran


@pytest.fixture
def searching():
    """The name of a sweeper that gsbench does not know, so it gets the values of a search."""
    node = {"_target_": GRID, "max_batch_size": None, "params": {}}
    ConfigStore.instance().store(group="hydra/sweeper", name="searching", node=node)
    return "hydra/sweeper=searching"


# ---- commands


@pytest.mark.parametrize("name", ["gsbench", "basic"])
def test_any_sweeper_runs_all_jobs_by_any_launcher(ran, name):
    """The next tests mix the two."""
    words = [f"hydra/sweeper={name}", f"hydra/launcher={name}", "densify=adc,none", "seed=1,2"]
    assert command.launch([*QUICK, *words]) == 0
    found = [(one.values["densify"]["name"], one.values["seed"]) for one in ran]
    assert found == [("adc", 1), ("adc", 2), ("none", 1), ("none", 2)]
    assert {one.values["name"] for one in ran} == {"x"}
    assert not any(one.values["scene"]["validation"] for one in ran)


@pytest.mark.parametrize("launcher", ["gsbench", "basic"])
def test_a_search_sees_validation_views_only_and_has_an_experiment_of_its_own(
    ran, searching, launcher, logged
):
    words = [searching, f"hydra/launcher={launcher}", "densify=adc", "seed=1,3"]
    words += ["densify.interval=100,200", "eval.primary=psnr"]
    assert command.launch([*QUICK, *words]) == 0
    found = [(one.values["densify"]["interval"], one.values["seed"]) for one in ran]
    assert found == [(100, 1), (100, 3), (200, 1), (200, 3)]
    for one in ran:
        assert one.values["name"] == "x-tune"
        assert one.values["scene"]["validation"] is True
        assert one.values["eval"]["primary"] is None
    assert ran.asks == {False}  # no question is written
    assert "gsbench tables x-tune" in logged.text


def test_a_failed_trial_ends_its_sweeper_or_is_named_at_the_end(ran, capsys):
    with pytest.raises(InputError, match="no luck"):
        command.launch([*QUICK, "hydra/sweeper=basic", "seed=1,13"])
    assert command.launch([*QUICK, "hydra/launcher=basic", "seed=1,13"]) == 1
    assert "failed: courtyard/random-volumetric seed 13" in capsys.readouterr().err


@pytest.mark.parametrize(
    "error, said",
    [
        (RuntimeError("study is\ngone"), r"^hydra/sweeper=basic raised RuntimeError: study is gone$"),
        (InputError("the trial's own line"), "^the trial's own line$"),
    ],
)  # fmt: skip
def test_what_another_sweeper_raises_is_named_as_its_own(monkeypatch, runs, error, said):
    def run_main(*_):
        raise error

    monkeypatch.setattr(hydra_app, "run_main", run_main)
    with refusal(said):
        command.launch(["-m", "hydra/sweeper=basic", "densify=adc,mcmc"])


@pytest.mark.parametrize(
    "error, said",
    [
        (GsbenchError("ours"), "^ours$"),
        (ValueError("a\n b"), "^hydra/launcher=basic: a b .gsbench status tells"),
        (ValueError(), "^hydra/launcher=basic: ValueError "),
    ],
)
def test_any_error_of_another_launcher_is_one_line(ran, monkeypatch, error, said):
    def launch(jobs, initial_job_idx):
        raise error

    launcher = SimpleNamespace(launch=launch)
    monkeypatch.setattr(hydra_app.Plugins, "instantiate_launcher", lambda self, **_: launcher)
    with pytest.raises(GsbenchError, match=said):
        command.launch([*QUICK, "hydra/launcher=basic", "seed=1,2"])


def test_a_job_is_pickled_for_another_process():
    job = Job(done, ("a",), "/f")
    assert pickle.loads(pickle.dumps(job)) == job


def test_a_single_trial_with_hydras_log_runs_where_the_command_was_given(ran, logged):
    here = os.getcwd()
    assert command.launch(split("seed=4 init=random hydra/job_logging=default")) == 0
    (one,) = ran
    assert os.getcwd() == here
    assert f"the trial's folder is {one.folder}" in logged.text


# ---- searches


@pytest.mark.parametrize(
    "sweeper, sign",
    table(__file__, "sweepers"),
)
def test_another_sweeper_gets_the_mean_over_the_seeds_towards_its_end(
    tmp_path, monkeypatch, sweeper, sign
):
    values = {"name": "x", "eval": {"primary": "lpips_vgg", "extra": {}}}
    config = OmegaConf.create({"hydra": {"sweeper": sweeper | {"params": {"seed": "1,2"}}}})
    asked = SimpleNamespace(
        words=["densify=m"],
        other_sweeper="optuna",
        trial=lambda words: SimpleNamespace(values=values),
        config=config,
    )
    goal = goal_of(asked)
    assert goal == Goal("x-tune", "lpips_vgg", -1, sign, ("seed=1", "seed=2"))
    trials = [trial(tmp_path, seed) for seed in (0, 1)]
    for one, lpips in zip(trials, (0.2, 0.4), strict=True):
        write_results(one.folder, one.values, metrics={"lpips_vgg": lpips})
    assert goal.value(trials) == pytest.approx(-0.3 * sign)
    with pytest.raises(GsbenchError, match="has no lpips_vgg, which the sweeper needs"):
        goal.value([*trials, trial(tmp_path, 2)])
    monkeypatch.setattr(sweep, "facts_for", lambda metric, values: SimpleNamespace(direction=0))
    with refusal("whether more or less of it is better is not known"):
        goal_of(asked)
    assert goal_of(SimpleNamespace(other_sweeper="basic")) is None


def test_a_dry_run_of_another_sweeper_lists_a_grid_or_says_that_it_searches(capsys):
    def asked(name, **sweeper):
        words = split("hydra/sweeper=x hydra.sweeper.n=3 seed=1,2 densify=adc")
        config = OmegaConf.create({"hydra": {"sweeper": sweeper}})
        return words_without_sweeper(
            SimpleNamespace(words=words, other_sweeper=name, config=config)
        )

    assert asked("basic") == (["seed=1,2", "densify=adc", "hydra/sweeper=gsbench"], True)
    for sweeper, said in (({}, "proposes trials from"), ({"n_trials": 9}, "proposes 9 trials (")):
        assert asked("optuna", **sweeper) == (["densify=adc", "hydra/sweeper=gsbench"], False)
        assert said in capsys.readouterr().out


# ---- Hydra's own files

OWN_FILES = {
    "run": {"dir": "."},
    "sweep": {"dir": ".", "subdir": "."},
    "output_subdir": None,
    "job_logging": {},
}
OF_A_TRIAL = (
    "hydra.output_subdir=.hydra hydra/job_logging=default hydra.job_logging.root.handlers=[file]"
)
OF_JOBS = "hydra.run.dir=${runs}/.hydra hydra.sweep.subdir=${hydra.job.num}"


@pytest.mark.parametrize(
    "changes, typed, multirun, launch, added",
    table(__file__, "files"),
)
def test_hydra_writes_its_files_if_one_is_asked_for(
    monkeypatch, logged, changes, typed, multirun, launch, added
):
    own = copy.deepcopy(OWN_FILES)
    monkeypatch.setattr(hydra_main, "installed_nodes", lambda words: own)
    runtime = {"choices": {"hydra/launcher": "gsbench"}}
    config = OmegaConf.create(
        {"hydra": OWN_FILES | changes | {"runtime": runtime}, "launch": {"name": launch}}
    )
    assert words_for_files(config, typed, multirun) == added
    assert ("writes no files of Hydra's" in logged.text) == (launch == "local")


def test_another_launchers_jobs_get_a_folder_that_nobody_could_prepare(tmp_path):
    launcher = {"submitit_folder": "${hydra.sweep.dir}/.submitit/%j", "timeout_min": 60}
    own = {"hydra": {"sweep": {"dir": str(tmp_path)}, "launcher": launcher}}
    config = OmegaConf.create(own | {"runs": str(tmp_path)})
    config.hydra.runtime = {"choices": {"hydra/launcher": "submitit_local"}}

    def words(*typed):
        return words_for_new_folder(SimpleNamespace(config=config, words=typed))

    (first,), (second,) = (words("seed=0") for _ in range(2))
    assert first.startswith("hydra.sweep.dir=${runs}/.hydra/")
    assert first != second
    typed = f"hydra.sweep.dir={tmp_path}"
    assert words(typed) == []
    (tmp_path / ".submitit").mkdir()
    with refusal("results of jobs would be unpickled from it"):
        words(typed)
    for name in ("basic", "gsbench"):
        config.hydra.runtime.choices["hydra/launcher"] = name
        assert words() == []
