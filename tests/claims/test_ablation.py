"""Switches of densifiers: which are on, which runs they make, and verdicts on known gains."""

from dataclasses import MISSING, fields
from shlex import split

import numpy as np
import pytest

from gsbench.claims.ablation import (
    choose_switches,
    declared_switches,
    effective_run,
    judge_runs,
    markdown_table,
    off_settings,
    runs_to_train,
)
from gsbench.config.build import build
from gsbench.config.compose import compose_one
from gsbench.config.groups import options
from gsbench.densify.volumetric import Volumetric
from gsbench.runs.config_hash import config_hash
from gsbench.settings import Switch
from tests.analysis.helpers import trials_of
from tests.helpers import refusal
from tests.launch.test_record import TINY
from tests.trials import write_trial

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


def write_ablation(runs, gains, seeds=3):
    """Write trials in which each part of `NESTED` that acts adds its gain in PSNR.

    Returns their folders by run and scene.
    """
    keys = {}
    for number, chosen in enumerate(runs_to_train(NESTED)):
        for seed in range(seeds):
            noise = 0.001 * np.random.default_rng([number, seed]).normal()
            psnr = 26 + sum(gains[name] for name in chosen) + noise
            place = {"scene": "courtyard", "densify": "volumetric"}
            write_trial(runs, seed, f"{number:08x}", **place, psnr=psnr)
        keys[chosen] = {"courtyard": f"courtyard/sfm-volumetric/{number:08x}"}
    return keys


def test_each_combination_is_judged_against_the_run_with_all_parts(tmp_path):
    keys = write_ablation(tmp_path, {"rule": 1.0, "shrink": 0.4, "once": 0.0})
    verdicts = judge_runs(trials_of(tmp_path), keys, "psnr")
    found = {str(one.question.idea): (round(one.mean or 0.0, 2), one.outcome) for one in verdicts}
    assert found == {
        "without shrink": (-0.4, "refuted"),
        "without once": (0.0, "too small to matter"),
        "without once and shrink": (-0.4, "refuted"),
        "without once, rule and shrink": (-1.4, "refuted"),
    }
    assert verdicts[0].level == 0.05 / 4
    lines = markdown_table(verdicts)
    assert lines[0] == "| run | difference in PSNR (dB) from all parts | interval | verdict |"
    assert lines[2].startswith("| without once | ") or lines[2].startswith(
        "| without shrink | −0.4"
    )


def test_a_combination_whose_trials_are_missing_has_no_verdict(tmp_path):
    keys = write_ablation(tmp_path, {"rule": 1.0, "shrink": 0.4, "once": -0.2})
    last = list(keys)[-1]
    for path in (tmp_path / "exp").glob(f"{keys[last]['courtyard']}-seed*/results.json"):
        path.unlink()
    verdicts = judge_runs(trials_of(tmp_path), keys, "psnr")
    assert verdicts[-1].mean is None
    assert "| – | – | 3 of 6 trials" in markdown_table(verdicts)[-1]
    assert len(markdown_table(verdicts[-1:])) == 3


@pytest.mark.parametrize(
    "words, message",
    [
        ("densify=none", "declares no switch"),
        ("densify=adc,volumetric", "one densifier"),
        ("densify=adc densify.split_shrink=1.5,2", "only scene and seed"),
        ("densify=adc name=a,b", "only scene and seed"),
        ("densify=adc --switches opacity_rest", "did you mean opacity_reset"),
        ("densify=adc +densify.switches.a.off.split_shrnk=2", "split_shrnk"),
        ("densify=adc --fast", "unrecognized arguments: --fast"),
        (
            "densify=adc launch.stop_when_decided=true eval.primary=psnr seed=0,1",
            "stop_when_decided",
        ),
    ],
)
def test_bad_words_of_ablate_are_refused_in_one_line(runs, words, message, refused):
    assert message in refused(
        "ablate", *(word for word in TINY if word != "densify=none"), *split(words)
    )
    assert not (runs).exists()
