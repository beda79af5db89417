"""Hydra's task and its launchers, with stand-ins for compositions and trials."""

import logging
import os
import pickle
from types import SimpleNamespace

import pytest
from hydra.core.utils import JobReturn, JobStatus
from hydra.types import RunMode
from omegaconf import OmegaConf

from gsbench.app import plugins, sweep
from gsbench.app.plugins import Objective, TrialTask, metric_of
from gsbench.app.sweep import Ended
from gsbench.errors import GsbenchError, InputError
from gsbench.launch.jobs import Outcome
from tests.app.stand_ins import done, trial
from tests.helpers import refusal
from tests.trials import write_results

# ---- the value of a job


@pytest.mark.parametrize(
    "primary, found",
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
        (None, 1, 21.0),
        (None, -1, -21.0),
        ("lpips_vgg", 1, -0.3),
        ("lpips_vgg", -1, 0.3),
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
    with refusal("whether more or less of it is better is not known"):
        metric_of(third.values)


# ---- the task


@pytest.fixture
def job(tmp_path, monkeypatch):
    """A job of Hydra's that makes a trial for each list of words."""
    state = SimpleNamespace(mode=RunMode.RUN, log={}, did=[])

    def instance():
        overrides = OmegaConf.create({"hydra": ["hydra.mode=RUN", "hydra.x=1"], "task": ["a=1"]})
        own = {"job_logging": state.log, "verbose": "x", "mode": state.mode}
        node = SimpleNamespace(overrides=overrides, **own)
        return SimpleNamespace(cfg=SimpleNamespace(hydra=node))

    def resolve(config, allowed, words):
        state.did.append(("composed", allowed))
        return trial(tmp_path / "runs", config.seed, words)

    def note(name):
        return lambda *given: state.did.append((name, *given[-2:]))

    monkeypatch.setattr(plugins.HydraConfig, "instance", instance)
    monkeypatch.setattr(plugins, "check_permitted", note("checked"))
    monkeypatch.setattr(plugins, "allow_modules", note("allowed"))
    monkeypatch.setattr(plugins, "set_up_logging", note("logs"))
    monkeypatch.setattr(plugins, "trial_of_job", resolve)
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
    (one,) = task.ended.trials
    assert (one.values["seed"], one.overrides) == (4, ("hydra.x=1", "a=1"))
    assert [outcome.folder for outcome in task.ended.outcomes] == [one.folder]
    assert [name for name, *_ in job.did] == ["allowed", "checked", "logs", "composed"]
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
    assert task.ended == Ended()  # whoever launched it collects them
    for bad_input, kind in ((True, InputError), (False, GsbenchError)):

        def failing(trials, bad_input=bad_input):
            return [Outcome(one.folder, "failed", "no luck", bad_input) for one in trials]

        with pytest.raises(GsbenchError, match="no luck") as error:
            TrialTask(failing, folder=job.folder)(job.config)
        assert type(error.value) is kind

    def measured(trials):
        for one in trials:
            write_results(one.folder, one.values, metrics={"psnr": 20.0 + one.values["seed"]})
        return done(trials)

    task = TrialTask(measured, folder=job.folder, objective=Objective(-1, ("seed=1", "seed=4")))
    assert task(job.config) == pytest.approx(-22.5)
    assert [one.overrides[-1] for one in task.ended.trials] == ["seed=1", "seed=4"]
    assert len(task.ended.outcomes) == 2
    assert job.config.seed == 4
    alone = TrialTask(measured, folder=job.folder, objective=Objective(1))
    assert alone(job.config) == pytest.approx(24)


def test_a_task_is_pickled_without_what_it_collected(tmp_path):
    given = (done, ("a",), "/f", Objective(1, ("seed=1",)))
    task = TrialTask(*given, sweep=object(), ended=Ended([trial(tmp_path)]))
    assert pickle.loads(pickle.dumps(task)) == TrialTask(*given)


# ---- a sweep


@pytest.fixture
def begun(monkeypatch):
    begun = []
    monkeypatch.setattr(plugins, "begin_for_another_launcher", begun.append)
    return begun


def run_by(monkeypatch, trials, name, launch=None):
    """Run ``trials`` twice as gsbench's sweeper does by the launcher ``name``."""
    hydra = {"runtime": {"choices": {"hydra/launcher": name}}, "verbose": False}
    config = OmegaConf.create({"hydra": hydra})
    own = SimpleNamespace(composer=SimpleNamespace(keep_times=lambda config: None))
    task = TrialTask(done, sweep=own)
    hydras = SimpleNamespace(instantiate_launcher=lambda **_: SimpleNamespace(launch=launch))
    monkeypatch.setattr(plugins.Plugins, "instance", lambda: hydras)
    monkeypatch.setattr(plugins, "run_sweep", lambda sweep, run: [run(trials), run(trials)])
    task.run_sweep(None, config)
    return task.ended


def test_trials_go_to_the_chosen_launcher(tmp_path, monkeypatch, begun):
    trials = [trial(tmp_path, seed, ["hydra.x=1", f"seed={seed}"]) for seed in (0, 1)]
    assert run_by(monkeypatch, trials, "gsbench") == Ended(trials * 2, done(trials * 2))
    assert begun == []
    asked = []

    def launch(jobs, initial_job_idx):
        asked.append((jobs, initial_job_idx))
        good, bad = JobReturn(), JobReturn()
        good._return_value, bad._return_value = 1.0, InputError("no photos")
        return [good, bad]

    ended = run_by(monkeypatch, trials, "joblib", launch)
    words = [["seed=0"], ["seed=1"]]
    assert asked == [(words, 0), (words, 2)]
    assert begun == [trials, trials]
    assert ended.trials == trials * 2
    assert ended.outcomes[:2] == [
        Outcome(trials[0].folder, "done"),
        Outcome(trials[1].folder, "failed", "no photos", True),
    ]


@pytest.mark.parametrize(
    "error, said",
    [
        (GsbenchError("ours"), "^ours$"),
        (ValueError("a\n b"), "^hydra/launcher=joblib: a b .gsbench status tells"),
        (ValueError(), "^hydra/launcher=joblib: ValueError "),
    ],
)
def test_any_error_of_another_launcher_is_one_line(tmp_path, monkeypatch, begun, error, said):
    def launch(jobs, initial_job_idx):
        raise error

    with pytest.raises(GsbenchError, match=said):
        run_by(monkeypatch, [trial(tmp_path)], "joblib", launch)


def test_another_sweeper_gets_a_value_for_each_job(tmp_path):
    composed = []

    def compose_jobs(jobs):
        composed.extend(jobs)
        made = []
        for job in jobs:
            seed = int(dict(word.split("=") for word in job).get("seed", "7"))
            name = job[0].replace("=", "")
            made.append(trial(tmp_path / "runs", seed, job, scene={"name": name}))
        return made

    own = SimpleNamespace(composer=SimpleNamespace(trials=compose_jobs))

    def run(trials):
        outcomes = []
        for one in trials:
            name = one.values["scene"]["name"]
            value = 20.0 + one.values["seed"] + 10 * (name == "a2")
            write_results(one.folder, one.values, metrics={"psnr": value})
            status = "failed" if name == "a3" else "done"
            outcomes.append(Outcome(one.folder, status, "no luck", bad_input=True))
        return outcomes[::-1]

    jobs = [["a=1"], ["a=2"], ["a=3"]]
    task = TrialTask(run, objective=Objective(1, ("seed=1", "seed=2")), sweep=own)
    config = OmegaConf.create({"hydra": {"sweep": {"dir": str(tmp_path / "new/dir")}}})
    first, second, third = task.run_jobs(jobs, config)
    assert composed == [[*job, seed] for job in jobs for seed in ("seed=1", "seed=2")]
    assert (tmp_path / "new/dir").is_dir()
    assert [one.overrides for one in (first, second, third)] == jobs
    assert (first.status, first.return_value) == (JobStatus.COMPLETED, 21.5)
    assert second.return_value == 31.5
    assert third.status is JobStatus.FAILED
    assert isinstance(third._return_value, InputError)
    task.objective = Objective(-1)
    other, alone = task.run_jobs([["a=1"], ["a=2"]], config)
    assert (other.return_value, alone.return_value) == (-27.0, -37.0)
    assert composed[-1] == ["a=2"]
