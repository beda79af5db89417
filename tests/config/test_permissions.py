"""Runs folders and trainers of strangers run only what the user allows in each command."""

import json
import sys
from pathlib import Path

import pytest
import yaml

from gsbench import cli
from gsbench.app.command import compose_trials
from gsbench.config.compose import compose_one
from gsbench.config.trust import check_permissions
from gsbench.errors import InputError
from gsbench.launch.record import add_to_plan
from gsbench.pipeline.parts import build
from gsbench.runs.trial_folder import TrialFolder
from tests.strange import no_trial
from tests.strange import place as place

pytestmark = pytest.mark.usefixtures("place")
STRANGE_TRIALS = {
    "a class": ({"densify": {"_target_": "bomb.Bomb"}}, "add allow_targets=[bomb] to the command"),
    "a metric": (
        {"eval": {"extra": {"x": {"_target_": "bomb.Bomb"}}}},
        "add allow_targets=[bomb] to the command",
    ),
    "a program": (
        {
            "densify": {
                "_target_": "gsbench.densify.External",
                "name": "x",
                "command": "bash {data}",
                "version": "1",
                "result": "x.ply",
            }
        },
        "add allow_targets=[bash] to the command",
    ),
    "a program by another path": (
        {
            "densify": {
                "_target_": "gsbench.external.settings.External",
                "name": "x",
                "command": "bash {data}",
                "version": "1",
                "result": "x.ply",
            }
        },
        "add allow_targets=[bash] to the command",
    ),
    "a shell": (
        {"launch": {"setup": ["touch exploded"]}},
        "add allow_targets=[bash] to the command",
    ),
}


def strange_runs(settings):
    """A stranger's failed trial that is in no plan; its configuration allows itself everything."""
    (trial,) = compose_trials(["name=x"])
    values = json.loads(json.dumps(trial.values)) | {
        "allow_targets": ["bomb", "bash", "os", "gsbench", "bombs"]
    }
    for group, own in settings.items():
        values[group] |= own
    folder = Path(values["runs"]) / "x" / "courtyard" / "sfm-volumetric" / "01234567-seed0"
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(yaml.safe_dump(values))
    (folder / "failed.json").write_text(json.dumps({"message": "no luck"}))
    return folder


@pytest.mark.parametrize(
    "words", [["retry", "x"], ["retry", "x", "--dry-run"], ["retry", "x", "allow_targets=[other]"]]
)
@pytest.mark.parametrize("case", STRANGE_TRIALS)
def test_retry_runs_nothing_of_a_strangers_folder_without_permission(
    case, words, monkeypatch, refused
):
    settings, said = STRANGE_TRIALS[case]
    strange_runs(settings)
    monkeypatch.setattr("gsbench.app.command.run_trials", no_trial)
    assert said.replace("[", "[other,") in (error := refused(*words)) or said in error
    assert not Path("exploded").exists()


@pytest.mark.parametrize("case", ["a class", "a metric", "a program", "a program by another path"])
def test_verbs_that_only_read_run_nothing_of_a_strangers_folder(case):
    strange_runs(STRANGE_TRIALS[case][0])
    for words in (
        ["status"],
        ["status", "x"],
        ["status", "x", "--json"],
        ["tables", "x"],
        ["report", "x"],
    ):
        cli.run(words)
    assert not Path("exploded").exists()


def test_permissions_in_a_trials_configuration_are_dropped():
    folder = strange_runs({})
    assert "bomb" in (folder / "config.yaml").read_text()
    assert TrialFolder(folder).configuration()["allow_targets"] == []


def test_retry_runs_what_its_command_allows(monkeypatch):
    strange_runs({"densify": {"_target_": "mine.Mine"}})
    began = []
    monkeypatch.setattr("gsbench.app.command.run_trials", lambda trials: began.extend(trials) or 0)
    assert cli.run(["retry", "x", "allow_targets=[mine]"]) == 0
    assert [trial.values["allow_targets"] for trial in began] == [["mine"]]


def test_a_plan_gives_no_permission_and_no_folder_of_modules(place, monkeypatch, refused):
    """A stranger's plan has a permission, and names a folder whose ``mine`` leaves a mark."""
    theirs = place / "theirs"
    theirs.mkdir()
    (theirs / "mine.py").write_text(f"open({str(place / 'exploded')!r}, 'w')\nclass Mine: ...\n")
    words = ["name=x", "densify=adc", "densify._target_=mine.Mine", "seed=0,1"]
    add_to_plan(compose_trials([*words, "allow_targets=[mine]"], multirun=True))
    plan = place / "runs" / "x" / "plan.json"
    strange = plan.read_text().replace(f'"cwd": "{place}"', f'"cwd": "{theirs}"')
    assert str(theirs) in strange
    assert "allow_targets=[mine]" in strange
    plan.write_text(strange)
    began = []
    monkeypatch.setattr("gsbench.app.command.run_trials", lambda trials: began.extend(trials) or 0)
    assert "add allow_targets=[mine] to the command" in refused("retry", "x")
    monkeypatch.chdir(place)
    assert cli.run(["retry", "x", "allow_targets=[mine]"]) == 0
    values = began[0].values
    assert (
        build("densify", values["densify"], values["allow_targets"]).__class__.__module__ == "mine"
    )
    assert sys.modules["mine"].__file__ == str(place / "mine.py")
    assert not (place / "exploded").exists()


def test_a_plan_gives_no_folder_for_packages_of_settings(place, monkeypatch):
    """Hydra imports ``pkg://conf_of_mine`` while it composes: the user's own, not the plan's."""
    theirs = place / "theirs"
    for folder, line in (("theirs", f"open({str(place / 'exploded')!r}, 'w')\n"), (".", "")):
        (place / folder / "conf_of_mine").mkdir(parents=True)
        (place / folder / "conf_of_mine" / "__init__.py").write_text(line)
    monkeypatch.chdir(place)
    add_to_plan(compose_trials(["name=x", "seed=0,1"], multirun=True))
    plan = place / "runs" / "x" / "plan.json"
    content = json.loads(plan.read_text())
    for planned in content["trials"].values():
        planned |= {
            "cwd": str(theirs),
            "overrides": [*planned["overrides"], "hydra.searchpath=[pkg://conf_of_mine]"],
        }
    plan.write_text(json.dumps(content))
    assert cli.run(["retry", "x", "allow_targets=[conf_of_mine]", "--dry-run"]) == 0
    assert sys.modules.pop("conf_of_mine").__file__ == str(place / "conf_of_mine" / "__init__.py")
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
    [
        ([], "python"),
        (["densify.version_command=[curl,strange]"], "python,curl"),
        (["densify.version_command='bash -c true'"], "python,bash"),
        (["+densify.environment.PATH=/strange"], "python,PATH"),
        (
            ["+densify.environment.LD_PRELOAD=/strange.so", "densify.version_command=[git]"],
            "python,git,LD_PRELOAD",
        ),
        (["densify._target_=gsbench.external.settings.External"], "python"),
        (
            ["densify.command=['{p}','{data}']", "+densify.options.p=/strange/python"],
            "/strange/python",
        ),
    ],
)
def test_every_program_and_variable_of_another_trainer_needs_permission(words, missing):
    with pytest.raises(InputError) as caught:
        compose_one([*PROGRAM, *words])
    assert f"add allow_targets=[{missing}] to the command" in str(caught.value)
    values = compose_one([*PROGRAM, *words, f"allow_targets=[{missing}]"]).values
    build("densify", values["densify"], missing.split(","))
    for permission in missing.split(","):
        rest = [name for name in missing.split(",") if name != permission]
        with pytest.raises(InputError, match="allow_targets"):
            build("densify", values["densify"], rest)
        with pytest.raises(InputError, match="allow_targets"):
            check_permissions(values | {"allow_targets": rest})


@pytest.mark.parametrize(
    "target", ["gsbench.external.exchange.External", "gsbench.pipeline.parts.External"]
)
def test_the_class_of_other_trainers_is_refused_under_further_names(target):
    """Two names of the class ask for permissions; by any other name nothing is made."""
    with pytest.raises(InputError):
        build(
            "densify",
            {
                "_target_": target,
                "name": "x",
                "command": "bash {data}",
                "version": "1",
                "result": "x",
            },
            [],
        )
    with pytest.raises(InputError):
        compose_one([*PROGRAM, f"densify._target_={target}"])


def test_harmless_variables_need_no_permission():
    compose_one([*PROGRAM, "+densify.environment.OMP_NUM_THREADS='4'", "allow_targets=[python]"])


def test_a_version_command_cannot_use_values_that_are_known_later():
    with pytest.raises(InputError, match=r"unknown placeholder \{output\}"):
        compose_one([*PROGRAM, "densify.version_command=['{output}/x']", "allow_targets=[python]"])


def test_retry_sends_nothing_to_a_tracker_that_a_strangers_folder_names(monkeypatch, refused):
    address = "http://127.0.0.1:9"
    strange_runs({"tracking": {"uri": address}})
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    monkeypatch.setattr("gsbench.app.command.run_trials", no_trial)
    assert f"to allow it, type tracking.uri={address}" in refused("retry", "x")
    began = []
    monkeypatch.setattr("gsbench.app.command.run_trials", lambda trials: began.extend(trials) or 0)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", address)
    assert cli.run(["retry", "x"]) == 0
    assert len(began) == 1
