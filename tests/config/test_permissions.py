"""Runs folders and trainers of strangers run only what the user allows in each command."""

import json
import os
import re
import sys
from pathlib import Path
from shlex import split

import pytest
import yaml

from gsbench import cli
from gsbench.app.command import compose_trials
from gsbench.config.build import build
from gsbench.config.command_words import typed_permissions
from gsbench.config.compose import Trial, compose_one
from gsbench.config.overrides import value_text
from gsbench.config.trust import (
    ALLOWED,
    check_permissions,
    foreign_address,
    permission_advice,
)
from gsbench.errors import InputError
from gsbench.launch.record import record
from gsbench.runs.commands import Idea, Ledger, append, command_now
from gsbench.runs.trial_folder import TrialFolder
from gsbench.system.install import conf_dir
from tests.helpers import read_json, refusal, table, write
from tests.processes import completed
from tests.strange import experiment, nested, no_trial
from tests.strange import place as place

pytestmark = pytest.mark.usefixtures("place")

ADDRESS = "http://127.0.0.1:9"
STRANGE = table(__file__, "strange")
RETRIES = [["retry", "x", *more] for more in ([], ["--dry-run"], ["allow_targets=[other]"])]


@pytest.fixture(autouse=True)
def no_address(monkeypatch):
    """No variable of the environment has the address of a tracker."""
    for variable in ALLOWED["addresses"]:
        monkeypatch.delenv(variable, raising=False)


def strange_runs(settings):
    """A stranger's failed trial that is in no plan; its configuration allows itself everything."""
    (trial,) = compose_trials(["name=x"])
    values = json.loads(json.dumps(trial.values)) | {
        "allow_targets": split("bomb bash os gsbench bombs")
    }
    nested(settings, values)
    folder = Path(values["runs"]) / "x/courtyard/sfm-volumetric/01234567-seed0"
    write(folder / "config.yaml", yaml.safe_dump(values))
    write(folder / "failed.json", {"message": "no luck"})
    return folder


def _words(settings):
    return [f"{key}={value_text(value)}" for key, value in settings.items()]


def test_a_choice_that_leaves_its_groups_folder_is_refused(refused):
    experiment({"runs": "theirs"})
    outside = os.path.relpath("conf/experiment/strange", Path(conf_dir(), "experiment"))
    assert "Parent traversal ('..')" in refused(f"+experiment={outside}")


def _plan(settings):
    (trial,) = compose_trials(["name=x"])
    record([Trial(trial.values, ("name=x", *_words(settings)))], asks=False)
    return RETRIES


def _ledger(settings):
    """A stranger's ledger with a kept idea, whose baseline has the settings."""
    home, words = Path("runs/x"), (*_words(settings), "seed=0,1,2,3")
    opened = {"metric": "psnr", "sign": 1, "least": 0.5, "relative": False, "ideas": 40}
    book = Ledger(**opened, rate=0.1, seeds=(0, 1))
    for name, hash_, against in (("baseline", "0", ""), ("i", "1", "baseline")):
        digests = {"courtyard": f"sfm-adc/{hash_}"}
        idea = Idea(name=name, identity=hash_, words=words, digests=digests, against=against)
        line = command_now((), ledger=None if against else book, idea=idea)
        append(home, lambda history, line=line: line)
    return [split("ledger try x densify.split_size=0.02")]


def _configuration(settings):
    strange_runs(settings)
    return RETRIES


def _experiment(settings):
    words = experiment(settings)
    return [words, [*words, "--dry-run"], ["-m", *words, "seed=0,1"]]


FILES = {
    "plan": _plan,
    "ledger": _ledger,
    "config.yaml": _configuration,
    "experiment": _experiment,
}
# what a file cannot set: only an experiment starts Hydra's app, and `retry` knows its runs folder
OF_AN_APP = ("Hydra's folder", "Hydra's files", "a log")
CANNOT_SET = {("plan", "a folder to write"), ("config.yaml", "a folder to write")}
CANNOT_SET |= {(file, case) for file in FILES if file != "experiment" for case in OF_AN_APP}
CANNOT_SET |= {("config.yaml", case) for case, (own, _) in STRANGE.items() if "hydra" in str(own)}
CANNOT_SET |= {("experiment", "a package of settings")}
KINDS = ("an address", "a class", "a program", "a shell", "a package of settings", "a callback")
KINDS += ("a class and its permission", "a folder to write", "a variable")


@pytest.mark.parametrize(
    "file, case",
    [
        # quick tests have all cases in an experiment, and one of each kind in the other files
        pytest.param(
            file, case, marks=[pytest.mark.slow] * (file != "experiment" and case not in KINDS)
        )
        for file in FILES
        for case in STRANGE
        if (file, case) not in CANNOT_SET
    ],
)
def test_no_file_of_a_stranger_decides_what_runs_and_where_results_go(
    file, case, monkeypatch, refused
):
    settings, said = STRANGE[case]
    for function in ("verbs.ledger.run_trials", "app.command.run_batch"):
        monkeypatch.setattr(f"gsbench.{function}", no_trial)
    commands = FILES[file](settings)
    for words in commands if case == "an address" else commands[:1]:
        line = refused(*words)
        assert said.replace("=[", "=[other,") in line or said in line
    assert not Path("exploded").exists()
    assert not Path("theirs").exists()


@pytest.mark.parametrize(
    "case", ["an address", "a class", "a metric", "a program", "a tracker", "a reader"]
)
def test_verbs_that_only_read_run_nothing_of_a_strangers_folder(case):
    strange_runs(STRANGE[case][0])
    for verb in ("status", "tables", "report", *["sync"] * (case in ("an address", "a tracker"))):
        cli.run([verb, "x"])
    assert not Path("exploded").exists()


def test_sync_shows_trials_by_a_class_that_its_command_allows(capfd):
    folder = strange_runs(STRANGE["a tracker"][0])
    assert cli.run(["sync", "x"]) == 0
    assert "add allow_targets=[bomb] to the command; no file can" in capfd.readouterr().out
    values = yaml.safe_load((folder / "config.yaml").read_text())
    values["tracking"]["_target_"] = "mine.Mine"
    (folder / "config.yaml").write_text(yaml.safe_dump(values))
    assert cli.run(["sync", "allow_targets=[mine]"]) == 0  # it was imported
    assert "mine.Mine is not a class for tracking: it has no open, " in capfd.readouterr().out
    assert cli.run(["sync", "x", "name=y"]) == 2
    assert "sync reads only allow_targets, not name=y" in capfd.readouterr().err


def test_permissions_in_a_trials_configuration_are_dropped():
    folder = strange_runs({})
    assert "bomb" in (folder / "config.yaml").read_text()
    assert TrialFolder(folder).configuration()["allow_targets"] == []


def test_retry_runs_what_its_command_allows(ran):
    strange_runs({"densify._target_": "mine.Mine"})
    assert cli.run(["retry", "x", "allow_targets=[mine]"]) == 0
    assert [trial.values["allow_targets"] for trial in ran] == [["mine"]]


def test_a_plan_gives_no_permission_and_no_folder_of_modules(place, ran, monkeypatch, refused):
    """A stranger's plan has a permission, and names a folder whose ``mine`` leaves a mark."""
    theirs = place / "theirs"
    theirs.mkdir()
    (theirs / "mine.py").write_text(f"open({str(place / 'exploded')!r}, 'w')\nclass Mine: ...\n")
    words = split("name=x densify=adc densify._target_=mine.Mine seed=0,1")
    record(compose_trials([*words, "allow_targets=[mine]"], multirun=True), asks=False)
    plan = place / "runs/x/commands.jsonl"
    strange = plan.read_text().replace(f'"cwd": "{place}"', f'"cwd": "{theirs}"')
    assert str(theirs) in strange
    assert "allow_targets=[mine]" in strange
    plan.write_text(strange)
    assert "add allow_targets=[mine] to the command" in refused("retry", "x")
    monkeypatch.chdir(place)
    assert cli.run(["retry", "x", "allow_targets=[mine]"]) == 0
    values = ran[0].values
    assert (
        build("densify", values["densify"], values["allow_targets"]).__class__.__module__ == "mine"
    )
    assert sys.modules["mine"].__file__ == str(place / "mine.py")
    assert not (place / "exploded").exists()


def test_a_plan_reaches_no_other_experiment(place, refused):
    record(compose_trials(["name=x", "seed=0,1"], multirun=True), asks=False)
    plan = place / "runs/x/commands.jsonl"
    plan.write_text(plan.read_text().replace("name=x", "name=mine"))
    for words in (["retry", "x"], ["retry", "x", "--dry-run"]):
        assert "is planned as a trial of mine, not of x" in refused(*words)
    assert not (place / "runs/mine").exists()


def test_a_plan_gives_no_folder_for_packages_of_settings(place, monkeypatch):
    """Hydra imports ``pkg://conf_of_mine`` while it composes: the user's own, not the plan's."""
    theirs = place / "theirs"
    for folder, line in (("theirs", f"open({str(place / 'exploded')!r}, 'w')\n"), (".", "")):
        (place / f"{folder}/conf_of_mine").mkdir(parents=True)
        (place / f"{folder}/conf_of_mine/__init__.py").write_text(line)
    monkeypatch.chdir(place)
    record(compose_trials(["name=x", "seed=0,1"], multirun=True), asks=False)
    plan = place / "runs/x/commands.jsonl"
    content = read_json(plan)
    content["cwd"] = str(theirs)
    for planned in content["trials"].values():
        planned["words"] = [*planned["words"], "hydra.searchpath=[pkg://conf_of_mine]"]
    write(plan, content)
    assert cli.run(["retry", "x", "allow_targets=[conf_of_mine]", "--dry-run"]) == 0
    assert sys.modules.pop("conf_of_mine").__file__ == str(place / "conf_of_mine/__init__.py")
    assert not (place / "exploded").exists()


# ---- programs

PROGRAM = [
    "densify=external/program",
    "densify.command=[python,'{data}']",
    "densify.result=x.ply",
    "densify.version='1'",
]


@pytest.mark.parametrize(
    "words, missing",
    table(__file__, "programs"),
)
def test_every_program_and_variable_of_another_trainer_needs_permission(words, missing):
    with refusal(re.escape(f"add allow_targets=[{missing}] to the command")):
        compose_one([*PROGRAM, *words])
    values = compose_one([*PROGRAM, *words, f"allow_targets=[{missing}]"]).values
    build("densify", values["densify"], missing.split(","))
    for permission in missing.split(","):
        rest = [name for name in missing.split(",") if name != permission]
        with refusal("allow_targets"):
            build("densify", values["densify"], rest)
        with refusal("allow_targets"):
            check_permissions(values | {"allow_targets": rest})


@pytest.mark.parametrize(
    "target", ["gsbench.config.build.External", "gsbench.pipeline.parts.External"]
)
def test_the_class_of_other_trainers_is_refused_under_further_names(target):
    """Two names of the class ask for permissions; by any other name nothing is made."""
    settings = {"_target_": target, "name": "x", "command": "bash {data}", "version": "1"}
    with pytest.raises(InputError):
        build("densify", settings | {"result": "x"}, [])
    with pytest.raises(InputError):
        compose_one([*PROGRAM, f"densify._target_={target}"])


def test_harmless_variables_need_no_permission():
    compose_one([*PROGRAM, "+densify.environment.OMP_NUM_THREADS='4'", "allow_targets=[python]"])


def test_a_version_command_cannot_use_values_that_are_known_later():
    with refusal(r"unknown placeholder \{output\}"):
        compose_one([*PROGRAM, "densify.version_command=['{output}/x']", "allow_targets=[python]"])


def test_an_address_counts_if_it_is_typed_or_in_the_environment(place, ran, monkeypatch, refused):
    """It counts as typed if a typed choice of a tracker has it, not if another file changes it."""
    strange_runs({"tracking.uri": ADDRESS})
    assert cli.run(["retry", "x", f"allow_targets=[{ADDRESS}]"]) == 0
    monkeypatch.setenv("MLFLOW_TRACKING_URI", ADDRESS)
    assert cli.run(["retry", "x"]) == 0
    assert len(ran) == 2
    monkeypatch.delenv("MLFLOW_TRACKING_URI")
    assert compose_one([f"tracking.uri={ADDRESS}"]).values["allow_targets"] == [ADDRESS]
    words = experiment({"tracking.uri": ADDRESS})
    write(Path("conf/tracking/lab.yaml"), "name: lab\nuri: http://lab:5000\n")
    lab = split("--config-dir conf tracking=lab --dry-run")
    assert cli.run(lab) == 0
    assert f"results would go to {ADDRESS}" in refused(*words, "tracking=lab")


@pytest.mark.parametrize(
    "tracking, allowed, found",
    table(__file__, "addresses"),
)
def test_addresses_of_any_tracker_are_found(tracking, allowed, found):
    assert foreign_address(tracking, allowed) == found


@pytest.mark.parametrize(
    "name", ["mine", "a b", "it's", "$(touch exploded)", "`touch exploded`'", 'a"b', "a;b", "!x"]
)
def test_the_advice_can_be_typed_in_a_shell_and_runs_nothing_there(name, tmp_path):
    word = permission_advice([name], ["other"]).removeprefix("add ").partition(" to the command")[0]
    done = completed(["sh", "-c", f"printf %s {word}"], cwd=tmp_path)
    if "$" in name:  # never a permission
        assert name in done.stdout
    else:
        assert typed_permissions([done.stdout]) == ("other", name)
    assert not (tmp_path / "exploded").exists()
