"""Each default has one source.

A group's settings have the defaults of its dataclass, and a file states only what it changes. The
file of a densifier or initialiser states all options, since its class would load torch: they are
the class's own defaults. A file that is built on another of the same class states what it changes.
"""

import dataclasses
import importlib
from shlex import split

import pytest
import yaml

from gsbench.config.schema import GROUP_SCHEMAS
from gsbench.settings import option_fields
from gsbench.system.install import conf_dir

# keys that tell the files of a group apart
NAMES = ("name", "kind", "protocol", "path", "_target_", "enabled")


def read(path):
    content = yaml.safe_load((conf_dir() / f"{path}.yaml").read_text(encoding="utf-8"))
    return content if isinstance(content, dict) else {}


def bases(path):
    """The files of the same group that a file is built on, nearest first."""
    group = path.partition("/")[0]
    for entry in read(path).get("defaults", []):
        name = str(entry).partition("@")[0] if isinstance(entry, str) else ""
        if name and name != "_self_" and not name.startswith("/"):
            base = next(
                base
                for base in (f"{group}/{name}", f"{group}/shared/{name}")
                if (conf_dir() / f"{base}.yaml").exists()
            )
            yield base
            yield from bases(base)


def class_of(path):
    """The dataclass whose options a file states."""
    targets = [
        values["_target_"] for values in map(read, (path, *bases(path))) if "_target_" in values
    ]
    if targets:
        module, _, name = targets[0].rpartition(".")
        found = getattr(importlib.import_module(module), name)
        return found if dataclasses.is_dataclass(found) else None
    return GROUP_SCHEMAS.get(path.partition("/")[0])


FILES = [
    path
    for group in split("densify eval init launch raster scene tracking train")
    for path in sorted(f"{group}/{file.stem}" for file in (conf_dir() / group).glob("*.yaml"))
    # other scenes only say where a capture lies and of which kind it is
    if group != "scene" or path == "scene/courtyard"
]


def stated(*paths):
    """The values that files state, except names and references to other settings."""
    values = {}
    for file in paths:
        values |= read(file)
    given = {
        key: value for key, value in values.items() if key not in ("defaults", "_target_", *NAMES)
    }
    return {key: value for key, value in given.items() if not str(value).startswith(("${", "???"))}


def plain(value):
    return list(value) if isinstance(value, tuple) else value


@pytest.mark.parametrize("path", FILES)
def test_each_default_has_one_source(path):
    cls = class_of(path)
    if cls is None:  # a function, or a class without options
        return
    defaults = {
        field.name: field.default
        if field.default_factory is dataclasses.MISSING
        else field.default_factory()
        for field in option_fields(cls)
    }
    above = list(bases(path))
    introduces = cls not in (GROUP_SCHEMAS.get(path.partition("/")[0]), *map(class_of, above))
    values = stated(*reversed(above), path) if introduces else stated(path)
    for key in values.keys() & {key for key, v in defaults.items() if v is not dataclasses.MISSING}:
        same = plain(values[key]) == plain(defaults[key])
        assert same == introduces, f"{path}: {key}={values[key]}, by default {defaults[key]}"


def test_files_are_told_apart_by_their_classes():
    assert {class_of(path).__name__ for path in ("eval/paper", "train/paper", "init/sfm")} == {
        "EvalConfig",
        "TrainConfig",
        "Sfm",
    }
    assert class_of("densify/absgrad") is class_of("densify/adc")
    assert class_of("densify/edgeaware") is not class_of("densify/longaxis")
