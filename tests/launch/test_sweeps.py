"""Composition, plan, states and finished trials, without trainings."""

import errno
import os
from dataclasses import replace
from functools import cache
from itertools import product
from shlex import split

import pytest
import yaml

from gsbench.app.command import compose_trials, launch, run_trials
from gsbench.config.command_words import parse
from gsbench.config.compose import compose_one
from gsbench.config.groups import options
from gsbench.config.trust import check_target
from gsbench.files import DiskFullError
from gsbench.launch import estimates, jobs
from gsbench.launch.batch import run_batch
from gsbench.launch.estimates import FinishedTrials, describe_plan
from gsbench.launch.jobs import Outcome
from gsbench.launch.record import record
from gsbench.launch.states import states_of_experiment
from gsbench.logs import set_up_logging
from gsbench.runs.code import config_hash
from gsbench.runs.commands import drop, read_history
from gsbench.runs.keys import TRAIN, Step
from gsbench.runs.store import Store
from gsbench.runs.trial_folder import TrialFolder
from gsbench.system.locks import BusyError, hold
from tests.composed import composed
from tests.helpers import refusal, write
from tests.trials import bare_trial, record_of

pytestmark = pytest.mark.usefixtures("runs")


def trial_values(*words):
    """A configuration in this test's runs folder."""
    (trial,) = composed(words)
    return trial.values


def finish(values, seconds=100.0, awaited=()):
    """Make the files of a finished trial, with one stage in the store and one source file."""
    folder = TrialFolder.of(values)
    source = folder.runs.parent / "photos/a.jpg"
    if not source.exists():
        write(source, b"photo")
    entry = Store(folder.runs / "store").get(
        Step(TRAIN, {"x": 1}, lambda folder: (folder / "model").write_text("m"))
    )
    published = write(folder.path / "table.csv", "a,b")
    write(folder.path / "config.yaml", yaml.safe_dump(values))
    results = record_of(
        values,
        seconds={"init": 1.0, "train": seconds, "evaluate": 0.0},
        hashes={"config": config_hash(values)},
        resolution=(400, 300),
        awaited=list(awaited),
    )
    folder.write_finished(values, results, [source], {"train": entry.path}, [published])
    return results


# ---- composition


@cache
def experiment(name):
    """The trials of an experiment, composed once: the paper's tables take seconds."""
    return compose_trials([f"+experiment={name}"])


PROGRAM = split(
    "densify.version=1.0 allow_targets=[mine,python,git,brush,opensplat,bash,LichtFeld-Studio]"
)
NEEDED = {  # what a YAML leaves to its user
    "external/program": ["densify.command=[mine]", "densify.result=mine.ply"],
    "external/3dgs": ["densify.options.code=/code"],
    "external/gsplat": ["densify.options.code=/code"],
}


@pytest.mark.slow
def test_every_experiment_and_every_other_trainer_composes():
    """The other files are composed in tests/config/test_schema.py."""
    for name in options("experiment"):
        # not the paper's 13 scenes; these claims list captures with paths of their own
        scene = [] if name == "claims_volumetric" else ["scene=courtyard"]
        assert len(compose_trials([f"+experiment={name}", *scene])) >= 2
    for name in (one for one in options("densify") if "/" in one):
        words = ["scene=courtyard", f"densify={name}", *PROGRAM, *NEEDED.get(name, [])]
        (trial,) = compose_trials(words)
        own = name.rpartition("/")[2]
        assert trial.values["densify"]["name"] == {"program": "external"}.get(own, own)


@pytest.mark.slow
def test_paper_experiments_have_the_papers_trials_and_share_them():
    table1, table2 = experiment("table1"), experiment("table2")
    assert (len(table1), len(table2)) == (78, 144)
    leaves = [
        {(t.values["scene"]["name"], TrialFolder.of(t.values).path.name) for t in table}
        for table in (table1, table2)
    ]
    assert [len(leaf) for leaf in leaves] == [78, 144]
    assert len(leaves[0] | leaves[1]) == 150
    for trial in table2[::35]:
        assert trial.values["densify"]["max_gaussians"] == 3_400_000
        again = compose_one(trial.overrides)
        assert again.values | {"runs": ""} == trial.values | {"runs": ""}
        assert again.yaml.splitlines()[8:] == trial.yaml.splitlines()[8:]


def test_a_grid_is_the_product_of_its_lists_and_typed_words_replace_the_files():
    def made(trials):
        return [(one.values["densify"]["name"], one.values["seed"]) for one in trials]

    assert made(compose_trials(["+experiment=demo", "seed=5,7", "densify=adc"])) == [
        ("adc", 5),
        ("adc", 7),
    ]
    words = ["densify=adc,mcmc", "seed=range(3)", "train.iterations=10"]
    trials = compose_trials(words, multirun=True)
    assert made(trials) == [*product(("adc", "mcmc"), range(3))]
    assert {one.values["train"]["iterations"] for one in trials} == {10}


def test_the_hash_covers_settings_but_not_name_seed_and_machine():
    hash_of = lambda *words: config_hash(trial_values(*words))  # noqa: E731
    ignored = "name=other seed=9 device=cpu threads=1 launch=local tracking=none eval.primary=psnr"
    assert hash_of() == hash_of(*ignored.split())
    counted = "densify=adc train.iterations=7 init.seed=3 scene.width=99 eval=standard"
    assert len({hash_of(), *map(hash_of, counted.split())}) == 6


def test_mistake_in_a_users_yaml_is_named(tmp_path):
    text = "defaults: [paper, _self_]\nname: mine\niteratons: 5\n"
    write(tmp_path / "own/train/mine.yaml", text)
    words, _, _ = parse(["--config-dir", "own", "train=mine"])
    with refusal(r"iteratons is not a setting.*iterations"):
        compose_trials(words)


def test_a_missing_folder_stops_a_sweep_before_its_first_trial(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("GSBENCH_DATA", str(tmp_path / "data"))
    words = split("-m scene=courtyard,truck init=dataset tracking=none train.iterations=1")
    with refusal(r"scene truck: .*truck does not exist.*; .*gsbench fetch"):
        launch(words)
    assert not list((tmp_path / "runs").glob("*/*/*/*-seed*"))  # no trial has begun
    assert launch([*words, "--dry-run"]) == 0
    assert "scene truck: the folder" in capsys.readouterr().out


# ---- a _target_ is code


FOREIGN = "os.system subprocess.Popen gsbenchevil.Class gsbench_evil.X builtins.eval gsbench hydra.utils.instantiate"


@pytest.mark.parametrize("target", [*FOREIGN.split(), "", None, " gsbench.x"])
def test_foreign_targets_are_refused(target):
    with refusal("densify"):
        check_target(target, "densify", [])


def test_own_and_allowed_targets_pass():
    check_target("gsbench.densify.ADC", "densify", [])
    for allowed in ("mine", "mine.", "mine.sub.Class"):
        check_target("mine.sub.Class", "densify", [allowed])
    with refusal(r"allow_targets=\[mine,minefield\]"):
        check_target("minefield.Class", "densify", ["mine"])


# ---- finished trials


def test_a_dry_run_says_what_has_changed(runs):
    values = trial_values()
    finish(values)
    trial = replace(composed([])[0], values=values)
    assert describe_plan([trial])[0].startswith("done     courtyard/sfm-volumetric seed 0")
    (runs.parent / "photos/a.jpg").write_bytes(b"other")
    assert describe_plan([trial])[0].endswith(
        f"  will be checked: {runs.parent / 'photos' / 'a.jpg'} has changed"
    )


def test_a_dry_run_tells_arms_apart(runs):
    words = ["densify=adc", "densify.split_size=0.01,0.02"]
    trials = compose_trials(words, multirun=True)
    finish(trials[0].values)
    first, second, *_ = describe_plan(trials)
    assert first.startswith("done     courtyard/sfm-adc[split_size=0.01] seed 0 (")
    assert second.endswith(f"({trials[1].folder.name.partition('-')[0]})")


@pytest.mark.parametrize("missing", [["lpips_squeeze"], ["flip"], []])
def test_a_dry_run_checks_only_what_can_be_computed_now(runs, monkeypatch, missing):
    def unavailable(options):
        assert not options["download"]  # a dry run downloads nothing
        return missing

    monkeypatch.setattr(estimates, "unavailable_now", unavailable)
    values = trial_values()
    finish(values, awaited=["lpips_squeeze"])
    line = describe_plan([replace(composed([])[0], values=values)])[0]
    note = "  will be checked: it lacks lpips_squeeze, which can be computed now"
    assert line.endswith(note) == ("lpips_squeeze" not in missing)


# ---- plan and states


def test_the_plan_keeps_requested_trials_and_status_lists_missing_ones(runs):
    trials = compose_trials(["name=x", "densify=adc", "seed=0,1,2,3"], multirun=True)
    record(trials[:2], asks=False)
    record(trials, asks=False)
    folders = [TrialFolder.of(trial.values).path for trial in trials]
    assert list(read_history(runs / "x").planned) == folders
    assert (
        compose_one(read_history(runs / "x").planned[folders[1]].words).values == trials[1].values
    )
    finish(trials[0].values)
    for folder in folders[1:3]:
        write(folder / "config.yaml", "")
    write(folders[1] / "failed.json", {"message": "no luck\nsecond line"})
    with hold(folders[2] / ".lock", "a trial"):
        states = [(trial.state, trial.note) for trial in states_of_experiment(runs / "x")]
    assert states[0] == ("done", "")
    assert states[1] == ("failed", "no luck")
    assert states[2][0] == "running"
    assert f"process {os.getpid()}" in states[2][1]
    assert states[3] == ("missing", "never started")
    assert states_of_experiment(runs / "x")[2].state == "partial"
    drop(runs / "x", [folders[3]])
    assert len(states_of_experiment(runs / "x")) == 3


def test_dry_run_tells_states_and_time(runs):
    trials = [
        bare_trial(runs, seed, densify={"name": name}, raster={"name": "cpu"})
        for name in ("adc", "volumetric")
        for seed in (0, 1)
    ]
    assert describe_plan(trials)[-1].startswith("time: no estimate")
    finish(trials[0].values, seconds=600)
    finish(trials[1].values | {"name": "other"}, seconds=1200)
    lines = describe_plan(trials, parallel=2)
    assert [line.split()[0] for line in lines[:4]] == split("done missing missing missing")
    assert "as in other: nothing to compute" in lines[1]
    assert lines[4] == "4 trials: 1 done, 3 missing"
    # 2 x (600 + 1200) / 2, two at once
    assert lines[5] == "time: about 15 min, 2 at once, estimated from 2 finished trials"
    assert FinishedTrials(runs).elsewhere(TrialFolder.of(trials[1].values)) == "other"
    assert describe_plan(trials[1:2])[1:] == [
        "1 trial: 1 missing",
        "time: seconds, since other experiments have the results",
    ]


# ---- running a sweep


@pytest.fixture
def fake_trial(monkeypatch):
    """Replace the trial by one that does what ``behaviour[seed]`` says, and records the order."""
    behaviour = {}
    order = []

    def run_one(trial, wait):
        seed = trial.values["seed"]
        error = behaviour.get(seed)
        if isinstance(error, BusyError) and not wait:
            raise error
        order.append(seed)
        if isinstance(error, DiskFullError):
            raise error
        folder = TrialFolder.of(trial.values).path
        if error is not None and not isinstance(error, BusyError):
            from gsbench.launch.jobs import outcome_of_error

            return outcome_of_error(folder, error)
        finish(trial.values)
        return Outcome(folder, "done", "psnr 1")

    monkeypatch.setattr(jobs, "run_one", run_one)
    return behaviour, order


def sweep():
    return composed(split("name=x densify=adc seed=0,1,2 tracking=none"))


def test_failed_trial_does_not_stop_the_others(fake_trial, capsys):
    behaviour, order = fake_trial
    behaviour[1] = RuntimeError("broken")
    set_up_logging()  # as the command line does
    assert run_trials(sweep()) == 1
    assert order == [0, 1, 2]
    said = capsys.readouterr().err
    assert "2 of 3: courtyard/sfm-adc seed 1" in said
    assert "failed: courtyard/sfm-adc seed 1" in said
    order.clear()
    del behaviour[1]
    assert run_trials(sweep()) == 0
    assert order == [1]


def test_busy_trial_comes_last(fake_trial):
    behaviour, order = fake_trial
    behaviour[0] = BusyError("another process is at it")
    assert run_trials(sweep()) == 0
    assert order == [1, 2, 0]


def test_full_disk_ends_the_sweep(fake_trial):
    behaviour, order = fake_trial
    behaviour[0] = DiskFullError("the disk is full")
    with pytest.raises(Exception, match="the disk is full"):
        run_trials(sweep())
    assert order == [0]


@pytest.mark.parametrize("number", [errno.EFBIG, errno.ENOLCK, errno.EROFS])
def test_verbs_that_write_report_storage_errors_in_one_line(number, runs, monkeypatch, refused):
    def refuse(*arguments):
        raise OSError(number, os.strerror(number), str(runs / "x/commands.jsonl"))

    record([bare_trial(runs, words=["seed=0"])], asks=False)
    monkeypatch.setattr("gsbench.runs.commands.append", refuse)
    said = refused("status", "x", "--forget")
    assert len(said.splitlines()) == 1
    assert "commands.jsonl" in said


def test_finished_trials_are_found_in_a_read_only_folder(runs, monkeypatch):
    values = trial_values()
    finish(values)
    trials = [replace(composed([])[0], values=values)]
    before = sorted(path for path in runs.rglob("*"))

    def refuse(*arguments, **named):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(runs))

    for name in (
        "gsbench.files.TemporaryDirectory",
        "gsbench.files.atomic",
        "gsbench.launch.record.append",
    ):
        monkeypatch.setattr(name, refuse)
    (outcome,) = run_batch(trials)
    assert outcome.status == "done"
    assert sorted(path for path in runs.rglob("*")) == before
    with refusal("cannot be written to"):
        run_batch([replace(composed([])[0], values=trial_values("seed=1"))])
