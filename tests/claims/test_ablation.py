"""Switches of densifiers: which are on, which runs they make, and the experiment of these."""

from dataclasses import MISSING, fields
from shlex import split

import pytest
import yaml

from gsbench.app.command import compose_trials
from gsbench.config.build import build
from gsbench.config.compose import compose_one
from gsbench.config.groups import options
from gsbench.densify.volumetric import Volumetric
from gsbench.runs.code import config_hash
from gsbench.settings import Switch
from gsbench.verbs.planning import (
    choose_switches,
    declared_switches,
    effective_run,
    off_settings,
    runs_to_train,
)
from tests.helpers import refusal, table
from tests.launch.test_record import TINY

NESTED = {
    "rule": Switch({"stop": 0}),
    "shrink": Switch({"of": 1}, within="rule"),
    "once": Switch({"b": 2}, within="rule"),
}


def on(*names):
    return frozenset(names)


def test_a_switch_within_another_is_trained_only_where_the_other_is_on():
    runs = runs_to_train(NESTED)
    assert runs == [
        on("rule", "shrink", "once"),
        on("once", "rule"),
        on("rule", "shrink"),
        on("rule"),
        on(),
    ]
    assert effective_run(on("shrink", "once"), NESTED) == on()
    alone = {"shrink": NESTED["shrink"]}  # the rule is no switch here, so it stays on
    assert runs_to_train(alone) == [on("shrink"), on()]
    assert off_settings(on("rule"), NESTED) == {"of": 1, "b": 2}
    assert off_settings(on("rule", "shrink", "once"), NESTED) == {}


def test_switches_that_depend_on_each_other_are_refused():
    circle = {"a": Switch({"x": 1}, within="b"), "b": Switch({"y": 1}, within="a")}
    with refusal("circle"):
        runs_to_train(circle)
    chain = {
        "a": Switch({"x": 1}),
        "b": Switch({"y": 1}, within="a"),
        "c": Switch({"z": 1}, within="b"),
    }
    assert [sorted(found) for found in runs_to_train(chain)] == [
        ["a", "b", "c"],
        ["a", "b"],
        ["a"],
        [],
    ]


@pytest.mark.parametrize(
    "arm", [name for name in options("densify") if name != "none" and "/" not in name]
)
def test_every_declared_switch_of_every_arm_makes_another_densifier(arm):
    """The settings of a switch are allowed for the class, and they change the arm as configured."""
    values = compose_one([f"densify={arm}"]).values["densify"]
    own = type(build("densify", values, [])).SWITCHES
    found = declared_switches(own, values)
    for switch in found.values():
        made = build("densify", values | switch.off, [])
        assert all(getattr(made, key) == value for key, value in switch.off.items())
    assert all(switch.within in {"", *own} for switch in own.values())


def test_the_volumetric_class_declares_three_switches_and_only_those_that_are_on_count():
    once = compose_one(["densify=volumetric_once"]).values["densify"]
    assert list(declared_switches(Volumetric.SWITCHES, once)) == [
        "volume_rule",
        "shrink",
        "no_resplit",
    ]
    plain = compose_one(["densify=volumetric"]).values["densify"]
    assert list(declared_switches(Volumetric.SWITCHES, plain)) == ["volume_rule", "shrink"]
    defaults = {
        entry.name: entry.default for entry in fields(Volumetric) if entry.default is not MISSING
    }
    assert set().union(*(switch.off for switch in Volumetric.SWITCHES.values())) <= set(defaults)


def test_switches_in_a_yaml_file_do_not_change_the_configuration_hash():
    values = {"grow": 1, "switches": {"growth": {"off": {"grow": 0}, "words": "it grows"}}}
    assert declared_switches({}, values) == {"growth": Switch({"grow": 0}, "it grows")}
    plain = compose_one(["densify=adc"]).values
    named = compose_one(
        ["densify=adc", "+densify.switches={mine: {off: {split_shrink: 2}}}"]
    ).values
    assert config_hash(named) == config_hash(plain)
    assert build("densify", named["densify"], []).split_shrink == 1.6
    for wrong in ({"a": {}}, {"a": 1}, [1], {"a": {"off": 3}}, {"a": {"off": {"x": 1}, "of": 2}}):
        with refusal(r"densify\.switches"):
            declared_switches({}, {"switches": wrong})


def test_an_unknown_switch_is_refused_with_the_nearest_name():
    with refusal("did you mean shrink"):
        choose_switches(NESTED, ["shrnk"], "x")
    with refusal("declares no switch"):
        choose_switches({}, [], "x")
    assert list(choose_switches(NESTED, ["once"], "x")) == ["once"]


ABLATE = split("scene=courtyard init=random tracking=none eval.lpips=[] seed=0,1,2,3")
SWITCH = split("+densify.switches.size.off.split_size=0.5 --switches size")


def test_ablate_writes_an_experiment_with_a_grid_for_each_combination(runs, said, tmp_path):
    file = tmp_path / "conf/experiment/parts.yaml"
    words = ["ablate", *ABLATE, "densify=volumetric_once", "name=parts"]
    assert said(*words, "--out", file) == f"{file}: 20 trials of gsbench +experiment=parts\n"
    assert said(*words) == file.read_text()
    trials = compose_trials([f"hydra.searchpath=['file://{file.parents[1]}']", "+experiment=parts"])
    assert len(trials) == 20
    assert {trial.values["eval"]["baseline"] for trial in trials} == {"volumetric_once"}
    off = [
        {key: trial.values["densify"][key] for key in ("condition_of", "split_isotropic")}
        | {"rule": trial.values["densify"]["volume_stop"] != 0}
        for trial in trials[::4]
    ]
    as_configured = dict(off[0])
    assert [sum(one[key] != as_configured[key] for key in one) for one in off] == [0, 1, 1, 2, 3]


def test_ablate_takes_switches_that_the_command_names(runs, said):
    content = yaml.safe_load(said("ablate", *ABLATE, "densify=adc", *SWITCH))
    grids = content["hydra"]["sweeper"]["grids"]
    assert grids == [{"densify": "adc"}, {"densify": "adc", "densify.split_size": "0.5"}]


@pytest.mark.parametrize(
    "words, message",
    table(__file__, "bad words"),
)
def test_bad_words_of_ablate_are_refused_in_one_line(runs, words, message, refused):
    assert message in refused(
        "ablate", *(word for word in TINY if word != "densify=none"), *split(words)
    )
    assert not (runs).exists()
