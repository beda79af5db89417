"""Hydra's task, a sweep and other sweepers, with stand-ins for compositions and trials."""

import copy
import logging
import os
import pickle
from collections.abc import Sequence
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import pytest
from hydra.core.utils import JobReturn, JobStatus
from hydra.types import RunMode
from omegaconf import OmegaConf

from gsbench.app import command, other_sweepers, sweep
from gsbench.app.command import (
    check_sweep_settings,
    one_trial_per_scene,
    summarize,
    words_for_hydras_files,
)
from gsbench.app.grids import checked_grids
from gsbench.app.other_sweepers import prepare_other_sweeper, words_without_sweeper
from gsbench.app.sweep import Objective, Sweep, TrialTask, metric_of
from gsbench.config.compose import Trial
from gsbench.errors import GsbenchError, InputError
from gsbench.launch.jobs import Outcome
from gsbench.runs.trial_folder import TrialFolder
from tests.finished import write_results
from tests.launch.test_jobs import trial as bare_trial


def trial(runs: Any, seed: int = 0, words: Sequence[str] = (), **settings: Any) -> Trial:
    settings = {"eval": {"primary": None}} | settings
    launch = {"name": "serial", "parallel": 1, "wait": True}
    return Trial(bare_trial(runs, seed, launch, **settings).values, tuple(words))


def done(trials: Sequence[Trial]) -> list[Outcome]:
    return [Outcome(one.folder, "done") for one in trials]


# ---- the value of a job


@pytest.mark.parametrize(
    ("primary", "found"),
    [
        (None, ("psnr", 1)),
        ("ssim", ("ssim", 1)),
        ("lpips_vgg", ("lpips_vgg", -1)),
        ("psnr@extrapolation", ("psnr", 1)),
    ],
)
def test_a_trial_is_judged_by_its_declared_metric(primary, found):
    values = {"eval": {"primary": primary, "extra": {}}}
    assert metric_of(values) == found


def test_the_value_of_a_job_is_the_mean_of_its_seeds_towards_the_wanted_end(tmp_path, monkeypatch):
    for primary, sign, value in (
        *((None, 1, 21.0), (None, -1, -21.0)),
        *(("lpips_vgg", 1, -0.3), ("lpips_vgg", -1, 0.3)),
    ):
        trials = [trial(tmp_path, seed, eval={"primary": primary, "extra": {}}) for seed in (0, 1)]
        for one, psnr, lpips in zip(trials, (20.0, 22.0), (0.2, 0.4), strict=True):
            write_results(one.folder, one.values, metrics={"psnr": psnr, "lpips_vgg": lpips})
        assert Objective(sign).value(trials) == pytest.approx(value)
    third = trial(tmp_path, 2, eval=trials[0].values["eval"])
    with pytest.raises(GsbenchError, match="has no lpips_vgg, which the sweeper needs"):
        Objective(1).value([*trials, third])
    write_results(third.folder, third.values)  # without this metric
    with pytest.raises(GsbenchError, match="has no lpips_vgg"):
        Objective(1).value([*trials, third])
    monkeypatch.setattr(sweep, "facts_for", lambda metric, values: SimpleNamespace(direction=0))
    with pytest.raises(InputError, match="whether more or less of it is better is not known"):
        metric_of(third.values)


# ---- the task


@pytest.fixture
def job(tmp_path, monkeypatch) -> SimpleNamespace:
    """A job of Hydra's that makes a trial for each list of words."""
    state = SimpleNamespace(mode=RunMode.RUN, log={}, did=[])

    def instance() -> Any:
        node = {"job_logging": state.log, "verbose": "x", "overrides": ["w"], "mode": state.mode}
        return SimpleNamespace(cfg=SimpleNamespace(hydra=SimpleNamespace(**node)))

    def resolve(config: Any, words: Sequence[str]) -> Trial:
        return trial(tmp_path / "runs", config.seed, words)

    def note(name: str) -> Any:
        return lambda *given: state.did.append((name, *given[-2:]))

    monkeypatch.setattr(sweep.HydraConfig, "instance", instance)
    monkeypatch.setattr(sweep.compose, "check_permitted", note("checked"))
    monkeypatch.setattr(sweep.compose, "enforce_permissions", note("enforced"))
    monkeypatch.setattr(sweep, "allow_modules", note("allowed"))
    monkeypatch.setattr(sweep, "set_up_logging", note("logs"))
    monkeypatch.setattr(sweep.compose, "typed_words", lambda words: (["hydra.x=1"], ["a=1"]))
    monkeypatch.setattr(sweep.compose, "resolve_trial", resolve)
    (tmp_path / "given").mkdir()
    monkeypatch.chdir(tmp_path)
    state.folder = str(tmp_path / "given")
    state.config = OmegaConf.create({"seed": 4})
    return state


def test_a_single_trial_is_run_where_the_command_was_given(job, caplog):
    caplog.set_level(logging.INFO, "gsbench")
    task = TrialTask(done, allowed=("mine",), folder=job.folder)
    assert task(job.config) is None
    assert os.getcwd() == job.folder
    (one,) = task.trials
    assert (one.values["seed"], one.overrides) == (4, ("hydra.x=1", "a=1"))
    assert [outcome.folder for outcome in task.outcomes] == [one.folder]
    assert [name for name, *_ in job.did] == ["allowed", "checked", "logs", "enforced"]
    assert job.did[0] == ("allowed", ("mine",), job.folder)
    assert job.did[1][-1] == job.did[3][-1] == ("mine",)
    assert job.did[2] == ("logs", "x", False)
    assert not caplog.messages
    job.log = {"root": {"level": "INFO"}}
    TrialTask(done, folder="/nowhere")(job.config)
    assert job.did[-2] == ("logs", "x", True)
    assert caplog.messages == [f"the trial's folder is {one.folder}"]


def test_a_job_of_a_sweep_raises_its_failure_and_returns_its_value(job, tmp_path):
    job.mode = RunMode.MULTIRUN
    task = TrialTask(done, folder=job.folder)
    assert task(job.config) is None
    assert (task.trials, task.outcomes) == ([], [])  # whoever launched it collects them
    for bad_input, kind in ((True, InputError), (False, GsbenchError)):

        def failing(trials: Sequence[Trial], bad_input: bool = bad_input) -> list[Outcome]:
            return [Outcome(one.folder, "failed", "no luck", bad_input) for one in trials]

        with pytest.raises(GsbenchError, match="no luck") as error:
            TrialTask(failing, folder=job.folder)(job.config)
        assert type(error.value) is kind

    def measured(trials: Sequence[Trial]) -> list[Outcome]:
        for one in trials:
            write_results(one.folder, one.values, metrics={"psnr": 20.0 + one.values["seed"]})
        return done(trials)

    task = TrialTask(measured, folder=job.folder, objective=Objective(-1, ("seed=1", "seed=4")))
    assert task(job.config) == pytest.approx(-22.5)
    assert [one.overrides[-1] for one in task.trials] == ["seed=1", "seed=4"]
    assert len(task.outcomes) == 2
    assert job.config.seed == 4
    alone = TrialTask(measured, folder=job.folder, objective=Objective(1))
    assert alone(job.config) == pytest.approx(24)


def test_a_task_is_pickled_without_what_it_collected(tmp_path):
    task = TrialTask(done, True, ("a",), "/f", [{"a": 1}], Objective(1, ("seed=1",)))
    task.launch([trial(tmp_path)])
    assert (len(task.trials), len(task.outcomes)) == (1, 1)
    again = pickle.loads(pickle.dumps(task))
    assert again == TrialTask(done, True, ("a",), "/f", None, Objective(1, ("seed=1",)))


# ---- a sweep


@pytest.fixture
def begun(monkeypatch) -> list[Any]:
    begun: list[Any] = []
    monkeypatch.setattr(sweep, "begin_for_another_launcher", begun.append)
    return begun


def sweep_of(task: TrialTask, launcher: str, launch: Any = None, **more: Any) -> Sweep:
    hydra = {"runtime": {"choices": {"hydra/launcher": launcher}}}
    config = OmegaConf.create({"hydra": hydra | more})
    made: Any = launch and SimpleNamespace(launch=launch)
    return Sweep(config, task, None, made)  # type: ignore[arg-type]


def test_trials_go_to_the_chosen_launcher(tmp_path, begun):
    trials = [trial(tmp_path, seed, ["hydra.x=1", f"seed={seed}"]) for seed in (0, 1)]
    for name, look_only in (("gsbench", False), ("joblib", True)):
        task = TrialTask(done, look_only=look_only)
        sweep_of(task, name).launch(trials)
        assert task.trials == trials
    assert begun == []
    asked: list[Any] = []

    def launch(jobs: Any, initial_job_idx: int) -> list[JobReturn]:
        asked.append((jobs, initial_job_idx))
        good, bad = JobReturn(), JobReturn()
        good._return_value, bad._return_value = 1.0, InputError("no photos")
        return [good, bad]

    task = TrialTask(done)
    for _ in range(2):
        sweep_of(task, "joblib", launch).launch(trials)
    words = [["seed=0"], ["seed=1"]]
    assert asked == [(words, 0), (words, 2)]
    assert begun == [trials, trials]
    assert task.trials == trials * 2
    assert task.outcomes[:2] == [
        Outcome(trials[0].folder, "done"),
        Outcome(trials[1].folder, "failed", "no photos", True),
    ]


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (GsbenchError("ours"), "^ours$"),
        (ValueError("a\n b"), "^hydra/launcher=joblib: a b .gsbench status tells"),
        (ValueError(), "^hydra/launcher=joblib: ValueError "),
    ],
)
def test_any_error_of_another_launcher_is_one_line(tmp_path, begun, error, said):
    def launch(jobs: Any, initial_job_idx: int) -> None:
        raise error

    with pytest.raises(GsbenchError, match=said):
        sweep_of(TrialTask(done), "joblib", launch).launch([trial(tmp_path)])


def test_another_sweeper_gets_a_value_for_each_job(tmp_path, monkeypatch):
    composed: list[Any] = []

    def compose_jobs(loader: Any, config: Any, jobs: Any) -> list[Trial]:
        composed.extend(jobs)
        seeds = [int(dict(word.split("=") for word in job).get("seed", "7")) for job in jobs]
        name = lambda job: {"name": job[0].replace("=", "")}  # noqa: E731
        return [
            trial(tmp_path / "runs", seed, job, scene=name(job))
            for seed, job in zip(seeds, jobs, strict=True)
        ]

    monkeypatch.setattr(sweep.compose, "compose_jobs", compose_jobs)
    monkeypatch.setattr(sweep.OverridesParser, "create", lambda loader: None)

    def run(trials: Sequence[Trial]) -> list[Outcome]:
        outcomes = []
        for one in trials:
            name = one.values["scene"]["name"]
            value = 20.0 + one.values["seed"] + 10 * (name == "a2")
            write_results(one.folder, one.values, metrics={"psnr": value})
            status: Any = "failed" if name == "a3" else "done"
            outcomes.append(Outcome(one.folder, status, "no luck", bad_input=True))
        return outcomes[::-1]

    jobs = [["a=1"], ["a=2"], ["a=3"]]
    task = TrialTask(run, objective=Objective(1, ("seed=1", "seed=2")))
    found = sweep_of(task, "gsbench", sweep={"dir": str(tmp_path / "new" / "dir")})
    first, second, third = found.run_jobs(jobs)
    assert composed == [[*job, seed] for job in jobs for seed in ("seed=1", "seed=2")]
    assert (tmp_path / "new" / "dir").is_dir()
    assert [one.overrides for one in (first, second, third)] == jobs
    assert (first.status, first.return_value) == (JobStatus.COMPLETED, 21.5)
    assert second.return_value == 31.5
    assert third.status is JobStatus.FAILED
    assert isinstance(third._return_value, InputError)
    task.objective = Objective(-1)
    other, alone = found.run_jobs([["a=1"], ["a=2"]])
    assert (other.return_value, alone.return_value) == (-27.0, -37.0)
    assert composed[-1] == ["a=2"]


# ---- other sweepers


def config_of(**hydra: Any) -> Any:
    return OmegaConf.create({"name": "x", "hydra": {"sweeper": {}} | hydra})


@pytest.mark.parametrize(
    ("sweeper", "sign"),
    [
        ({"direction": "maximize"}, 1),
        ({"direction": "MAXIMIZE"}, 1),
        ({"direction": "minimize"}, -1),
        ({}, -1),
        ({"optim": {"maximize": True}}, 1),
        ({"optim": {"maximize": False}}, -1),
        ({"ax_config": {"experiment": {"minimize": False}}}, 1),
        ({"ax_config": {"experiment": {"minimize": True}}}, -1),
    ],
)
def test_another_sweeper_gets_all_seeds_of_a_job(monkeypatch, caplog, sweeper, sign):
    caplog.set_level(logging.INFO, "gsbench")
    composed: list[Any] = []
    monkeypatch.setattr(command.compose, "hydra_ready", nullcontext)
    monkeypatch.setattr(command.compose, "compose_whole", composed.append)
    values = {"eval": {"primary": "lpips_vgg", "extra": {}}}
    resolved = SimpleNamespace(values=values)
    monkeypatch.setattr(command.compose, "resolve_trial", lambda config, words: resolved)
    task = TrialTask(done)
    words = ["name=x", "densify=adc,mcmc", "densify.start=1,2", "seed=3,5"]
    config = config_of(sweeper=sweeper | {"params": {"seed": "1,2", "init": "sfm,dim"}})
    kept = prepare_other_sweeper(config, words, task, "optuna")
    assert kept == [*words[:3], "~hydra.sweeper.params.seed"]
    assert task.objective == Objective(sign, ("seed=3", "seed=5"))
    # each combination of choices is composed, and may then run code
    assert composed == [
        ["name=x", init, densify]
        for init in ("init=sfm", "init=dim")
        for densify in ("densify=adc", "densify=mcmc")
    ]
    said = f"gets {'-' if sign > 0 else ''}lpips_vgg of test views, "
    assert said + ("maximized" if sign > 0 else "minimized") in caplog.text
    config = config_of(sweeper=sweeper | {"params": {"seed": "1,2"}})
    assert prepare_other_sweeper(config, ["seed=9"], task, "optuna")[0] == "seed=9"
    assert task.objective == Objective(sign, ("seed=1", "seed=2"))
    assert prepare_other_sweeper(config_of(), ["a=1"], task, "optuna") == ["a=1"]
    assert task.objective == Objective(-1)


def test_hydras_grid_sweeper_asks_for_no_value_and_choices_are_limited(monkeypatch):
    monkeypatch.setattr(command.compose, "hydra_ready", nullcontext)
    monkeypatch.setattr(command.compose, "compose_whole", lambda words: None)
    task = TrialTask(done)
    words = ["densify=a,b", "seed=1,2"]
    assert prepare_other_sweeper(config_of(), words, task, "basic") == words
    assert task.objective == Objective(-1)
    monkeypatch.setattr(other_sweepers, "MAX_CHOICES", 4)
    words = ["densify=a,b", "init=a,b"]
    assert prepare_other_sweeper(config_of(), words, task, "basic") == words
    with pytest.raises(InputError, match="more than 4 combinations of choices"):
        prepare_other_sweeper(config_of(), ["densify=a,b", "init=a,b,c"], task, "basic")


def test_a_dry_run_of_another_sweeper_lists_a_grid_or_says_that_it_searches(capsys):
    words = ["hydra/sweeper=x", "hydra.sweeper.n=3", "seed=1,2", "densify=adc"]
    assert words_without_sweeper(config_of(), words, "basic") == (
        ["seed=1,2", "densify=adc", "hydra/sweeper=gsbench"],
        True,
    )
    for sweeper, said in (({}, "proposes trials from"), ({"n_trials": 9}, "proposes 9 trials (")):
        found = words_without_sweeper(config_of(sweeper=sweeper), words, "optuna")
        assert found == (["densify=adc", "hydra/sweeper=gsbench"], False)
        assert said in capsys.readouterr().out


OWN_FILES: dict[str, Any] = {
    **{"run": {"dir": "."}, "sweep": {"dir": ".", "subdir": "."}},
    **{"output_subdir": None, "job_logging": {}},
}


@pytest.mark.parametrize(
    ("changes", "typed", "multirun", "launch", "added"),
    [
        ({}, [], True, "serial", []),
        (
            {"run": {"dir": "here"}},
            [],
            False,
            "serial",
            [
                "hydra.output_subdir=.hydra",
                "hydra/job_logging=default",
                "hydra.job_logging.root.handlers=[file]",
            ],
        ),
        (
            {"output_subdir": "x", "job_logging": {"root": 1}},
            [],
            True,
            "serial",
            [
                "hydra.run.dir=${runs}/.hydra",
                "hydra.sweep.subdir=${hydra.job.num}",
                "hydra/launcher=basic",
            ],
        ),
        (
            {"sweep": {"dir": "a", "subdir": "b"}, "run": {"dir": "here"}},
            ["hydra.output_subdir=null", "hydra/job_logging=none"],
            True,
            "local",
            [],
        ),
    ],
)
def test_hydra_writes_its_files_if_one_is_asked_for(
    monkeypatch, caplog, changes, typed, multirun, launch, added
):
    caplog.set_level(logging.INFO, "gsbench")
    own = copy.deepcopy(OWN_FILES)
    monkeypatch.setattr(command.compose, "installed_nodes", lambda words: own)
    runtime = {"choices": {"hydra/launcher": "gsbench"}}
    config = OmegaConf.create(
        {"hydra": OWN_FILES | changes | {"runtime": runtime}, "launch": {"name": launch}}
    )
    assert words_for_hydras_files(config, typed, multirun) == added
    assert ("writes no files of Hydra's" in caplog.text) == (launch == "local")


@pytest.mark.parametrize(
    ("changes", "multirun", "said"),
    [
        ({}, False, None),
        ({"hydra.sweeper.params": {"seed": "0,1"}}, True, None),
        ({"hydra.sweeper.params": {"seed": "0,1"}}, False, "lists values: add -m"),
        ({"hydra.sweeper.grids": [1]}, False, "lists values: add -m"),
        ({"hydra.sweeper.grids": [1], "hydra.mode": "RUN"}, False, None),
        ({"hydra.sweeper.params": "x"}, True, "must map settings to values"),
        ({"launch.stop_when_decided": True}, True, None),
        ({"launch.stop_when_decided": True}, False, "adds seeds to a sweep"),
        ({"hydra.runtime.choices.hydra/launcher": "joblib"}, True, None),
        ({"hydra.runtime.choices.hydra/launcher": "joblib"}, False, "launches sweeps: add -m"),
        (
            {"hydra.runtime.choices.hydra/launcher": "joblib", "launch.name": "local"},
            True,
            "two launchers",
        ),
        ({"launch.name": "local"}, True, None),
    ],
)
def test_settings_of_a_sweep_need_a_sweep(changes, multirun, said):
    config = OmegaConf.create(
        {
            "hydra": {
                "sweeper": {"params": None, "grids": []},
                "mode": None,
                "runtime": {"choices": {"hydra/launcher": "gsbench"}},
            },
            "launch": {"stop_when_decided": False, "name": "serial"},
        }
    )
    for key, value in changes.items():
        OmegaConf.update(config, key, value, merge=False)
    if said is None:
        check_sweep_settings(config, multirun)
    else:
        with pytest.raises(InputError, match=said):
            check_sweep_settings(config, multirun)


@pytest.mark.parametrize("grids", ["x", [1], [{}], {"a": 1}])
def test_grids_are_a_list_of_mappings(grids):
    with pytest.raises(InputError, match=r"grids must be a list, each a mapping"):
        checked_grids(grids)
    assert checked_grids([{"a": 1, "b": True}, {"c": "1,2"}]) == [
        *({"a": "1", "b": "true"}, {"c": "1,2"})
    ]
    for value in (None, [1], {"a": 1}):
        with pytest.raises(InputError, match="grids: a must list values"):
            checked_grids([{"a": value}])


# ---- the end of a command


@pytest.mark.parametrize(
    ("ends", "code", "advice"),
    [
        ("dd", 0, "2 of 2 trials done; the table: gsbench tables x"),
        ("d", 0, "1 of 1 trials done; the table: gsbench tables x; renders and model: "),
        ("df", 1, "1 of 2 trials done; again: gsbench retry x"),
        ("bf", 1, "0 of 2 trials done; again: gsbench retry x"),
        ("bb", 2, "0 of 2 trials done; again: gsbench retry x"),
        ("dq", 0, "1 of 2 trials done; how far the others are: gsbench status x"),
        ("bq", 1, "0 of 2 trials done; how far the others are: gsbench status x"),
    ],
)
def test_the_end_of_a_command_tells_what_to_do_next(tmp_path, caplog, capsys, ends, code, advice):
    caplog.set_level(logging.INFO, "gsbench")
    status: Any = {"d": "done", "q": "queued", "f": "failed", "b": "failed"}
    trials = [trial(tmp_path, seed) for seed in range(len(ends))]
    outcomes = [
        Outcome(one.folder, status[end], "why", end == "b")
        for one, end in zip(trials, ends, strict=True)
    ]
    first = Trial(trials[0].values | {"name": "tuning"}, ())
    assert summarize(outcomes, [first, *trials]) == code
    (said,) = caplog.messages
    assert said == advice + (str(trials[0].folder) if len(ends) == 1 else "")
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("gsbench: ")]
    assert said == [
        f"gsbench: failed: {TrialFolder(one.folder).label}: why"
        for one in outcomes
        if one.status == "failed"
    ]


def test_the_failure_of_a_single_trial_is_raised(tmp_path):
    for bad_input, kind in ((True, InputError), (False, GsbenchError)):
        with pytest.raises(GsbenchError, match="why") as error:
            summarize([Outcome(tmp_path, "failed", "why", bad_input)], [trial(tmp_path)])
        assert type(error.value) is kind


def test_a_comparison_of_versions_has_a_trial_of_each_scene(tmp_path, monkeypatch):
    asked: list[Any] = []
    made = [trial(tmp_path, scene={"name": name}) for name in ("a", "b")]

    def compose_trials(words: Sequence[str], multirun: bool) -> list[Trial]:
        asked.append((words, multirun))
        return made

    monkeypatch.setattr(command, "compose_trials", compose_trials)
    assert one_trial_per_scene("gate", ["scene=a,b"], "train_time") == {"a": made[0], "b": made[1]}
    one_trial_per_scene("gate", ["+name=y"], "train_time")
    assert asked == [
        (["scene=a,b", "seed=0", "name=gate"], True),
        (["+name=y", "seed=0"], True),
    ]
    for words, said in (
        (["seed=1"], "seed follows from the other words"),
        (["+eval.primary=psnr"], r"eval\.primary follows from"),
    ):
        with pytest.raises(InputError, match=f"gate: {said}"):
            one_trial_per_scene("gate", words, "psnr")
    with pytest.raises(InputError, match="primary=nosuch"):
        one_trial_per_scene("gate", [], "nosuch")
    made.append(trial(tmp_path, 1, scene={"name": "a"}))
    with pytest.raises(InputError, match="gate is about one arm"):
        one_trial_per_scene("gate", [], "train_time")
    made[:] = [trial(tmp_path)]
    made[0].values["launch"]["wait"] = False
    with pytest.raises(InputError, match="gate waits for its trials"):
        one_trial_per_scene("gate", [], "train_time")
