"""A value that YAML and a class both state is the same, unless `DELIBERATE` lists it."""

import dataclasses
import importlib

import pytest
import yaml

from gsbench.config.schema import GROUP_SCHEMAS
from gsbench.settings import option_fields
from gsbench.system.install import conf_dir

# keys that tell the files of a group apart
NAMES = ("name", "kind", "protocol", "path", "sink", "enabled")
# group/file: the keys whose values differ from the class's own; a file that is built on another has
# the other's too
DELIBERATE = {
    "densify/absgrad": {"gradient", "gradient_threshold"},
    "densify/longaxis": {"gradient", "gradient_threshold"},
    "densify/revised": {"revised_opacity"},
    "densify/volumetric_once": {"split_isotropic"},
    "eval/standard": {"lpips"},
    "init/dim_paper": {"max_keypoints", "min_inlier_ratio", "pairs"},
    "init/sfm_preview": {"first_octave", "max_image_size", "max_num_features", "pairs"},
    "launch/local": {"parallel"},
    "launch/slurm": {"cpus_per_trial", "gpus_per_trial", "parallel", "timeout_min"},
    "train/7k": {"iterations", "volume_histogram"},
    "train/late2024": {"opacity"},
    "train/none": {"iterations"},
}
# Files that are built on another one, but have the defaults of a class of their own.
OWN_CLASS = {"densify/edgeaware", "densify/gns"}
# Files that differ in most keys: a shortened schedule, and the schedules of other authors, which
# tests/densify compares with their code.
WHOLE = {
    "train/quick",
    *(f"train/{name}" for name in ("fastgs", "improved_gs", "mrnf", "resgs", "taming")),
}


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
    for group in ("densify", "eval", "init", "launch", "raster", "scene", "tracking", "train")
    for path in sorted(f"{group}/{file.stem}" for file in (conf_dir() / group).glob("*.yaml"))
    # other scenes only say where a capture lies and of which kind it is
    if group != "scene" or path == "scene/courtyard"
]


def stated(path):
    """The values that a file and its bases state, except names and references to other settings."""
    values = {}
    for file in (*reversed(list(bases(path))), path):
        values |= read(file)
    given = {
        key: value for key, value in values.items() if key not in ("defaults", "_target_", *NAMES)
    }
    return {key: value for key, value in given.items() if not str(value).startswith(("${", "???"))}


def allowed(path):
    if path in OWN_CLASS:
        return DELIBERATE.get(path, set())
    return set().union(*(DELIBERATE.get(file, set()) for file in (path, *bases(path))))


def plain(value):
    return list(value) if isinstance(value, tuple) else value


@pytest.mark.parametrize("path", [path for path in FILES if path not in WHOLE])
def test_yaml_values_equal_the_defaults_of_the_class(path):
    cls = class_of(path)
    if cls is None:  # a function, or a class without options
        return
    defaults = {
        field.name: field.default
        if field.default_factory is dataclasses.MISSING
        else field.default_factory()
        for field in option_fields(cls)
    }
    differing = {
        key
        for key, value in stated(path).items()
        if key in defaults
        and defaults[key] is not dataclasses.MISSING
        and plain(value) != plain(defaults[key])
    }
    assert differing == allowed(path), (
        f"{path}: a value differs from the class's: correct it, or say so in DELIBERATE"
    )


def test_the_lists_name_existing_files():
    assert DELIBERATE.keys() | WHOLE <= set(FILES)
    assert {class_of(path).__name__ for path in ("eval/paper", "train/paper", "init/sfm")} == {
        "EvalConfig",
        "TrainConfig",
        "Sfm",
    }
