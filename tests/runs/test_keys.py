"""What enters the key of a step: options, the user's code, and packages; nested values."""

import doctest
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

from gsbench.runs import configuration, keys
from gsbench.runs.code import UserCode
from gsbench.runs.configuration import flatten, targets_in
from gsbench.runs.keys import Stage, options_of, rasterizer_inputs, step_of
from tests.helpers import refusal


@dataclass(frozen=True)
class Own:
    """A user's class; gsbench would leave ``threads`` out."""

    threads: int = 2
    place: Path = Path("a")
    pair: tuple[int, ...] = (1, 2)
    hidden: int = field(default=0, init=False)


def test_a_users_class_enters_a_key_with_its_code_and_all_its_options():
    user = UserCode({"tests": "0abc"}, {"densify": "tests.Own", "eval.extra.own": "gsbench.X"})
    options = {"threads": 2, "place": "a", "pair": [1, 2]}
    named = {"class": "tests.runs.test_keys.Own", "source": {"tests": "0abc"}} | options
    assert options_of("densify", Own(), user) == named
    # a class that is defined outside gsbench, under any name
    assert options_of("eval", Own(), user, "eval.extra.own") == named
    stage = Stage("scene", 1)  # of gsbench's own
    assert [user.is_behind(stage, place) for place in ("densify", "eval.extra.own", "init")] == [
        True,
        False,
        False,
    ]
    assert options_of("init", stage, user) == {
        "class": "gsbench.runs.keys.Stage",
        "name": "scene",
        "version": 1,
        "resumable": False,
        "scratch": [],
    }


def test_a_rasterizer_enters_a_key_by_its_name_or_as_a_users_class():
    rasterizer = SimpleNamespace(name="cpu")  # defined outside gsbench
    assert rasterizer_inputs(rasterizer, UserCode({"m": "1"})) == {
        "name": "cpu",
        "class": "types.SimpleNamespace",
        "source": {"m": "1"},
    }
    assert rasterizer_inputs(Stage("cpu", 1)) == "cpu"


def test_a_step_has_the_differing_packages_and_checks_for_edits_only_if_it_starts_processes(
    monkeypatch,
):
    states, edits = {"scene": "released", "init": "1234"}, []
    monkeypatch.setattr(keys, "states_of", lambda packages: states)
    monkeypatch.setattr(keys, "changed_since_asked", lambda packages: ["init"])
    monkeypatch.setattr(keys, "has_changed_since_import", edits.__contains__)
    given = keys.CAPTURE, {"x": 1}, lambda folder: None, UserCode({"mine": "5678"})
    step = step_of(*given, in_processes=True)
    assert (step.inputs, step.code) == ({"x": 1, "code": {"init": "1234"}}, states)
    with refusal("gsbench's init changed while scene ran"):
        step.check()
    edits.append("mine")
    with refusal("gsbench's init, code of mine changed"):
        step.check()
    step_of(*given).check()
    states.pop("init")
    assert step_of(*given).inputs == {"x": 1}


def test_the_example_in_the_docstring_holds():
    assert doctest.testmod(configuration).failed == 0


def test_empty_mappings_are_kept_only_if_asked():
    values = {"a": {"b": {"c": 1}, "e": {}}, "f": None}
    assert flatten(values) == {"a.b.c": 1, "f": None}
    assert flatten(values, keep_empty=True) == {"a.b.c": 1, "a.e": {}, "f": None}


def test_classes_are_found_at_any_depth_with_their_place():
    values = {"a": {"_target_": "x.Y", "b": [{"_target_": None}, {"c": 1, "_target_": "z.Z"}]}}
    assert list(targets_in(values)) == [(("a",), "x.Y"), (("a", "b", "1"), "z.Z")]
