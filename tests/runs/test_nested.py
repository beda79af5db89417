"""Flattening: one function for configurations, stage inputs and MLflow's parameters."""

import doctest

from gsbench.runs import nested
from gsbench.runs.nested import flatten, targets_in


def test_the_example_in_the_docstring_holds():
    assert doctest.testmod(nested).failed == 0


def test_empty_mappings_are_kept_only_if_asked():
    values = {"a": {"b": {"c": 1}, "e": {}}, "f": None}
    assert flatten(values) == {"a.b.c": 1, "f": None}
    assert flatten(values, keep_empty=True) == {"a.b.c": 1, "a.e": {}, "f": None}


def test_classes_are_found_at_any_depth_with_their_place():
    values = {"a": {"_target_": "x.Y", "b": [{"_target_": None}, {"c": 1, "_target_": "z.Z"}]}}
    assert list(targets_in(values)) == [(("a",), "x.Y"), (("a", "b", "1"), "z.Z")]
