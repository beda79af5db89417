"""The YAML files of initialisers have all options of the classes."""

import dataclasses
from pathlib import Path

import pytest

import gsbench.init
from gsbench.config.compose import compose_one

FOLDER = Path(__file__).parents[2] / "conf" / "init"
NAMES = sorted(path.stem for path in FOLDER.glob("*.yaml"))
REQUIRED = {"ply": ["init.path=a.ply"], "points": ["init.path=a.ply"]}


@pytest.mark.parametrize("name", NAMES)
def test_the_yaml_states_every_option(name):
    """Their defaults are compared by tests/config/test_yaml_defaults.py."""
    words = [f"init={name}", "scene=courtyard", *REQUIRED.get(name, [])]
    values = compose_one(words).values["init"]
    module, _, class_name = values.pop("_target_").rpartition(".")
    assert (module, values.pop("name")) == ("gsbench.init", name)
    cls = getattr(gsbench.init, class_name)
    assert cls.name in (name, name.partition("_")[0])  # a preset has another name
    assert values.keys() == {field.name for field in dataclasses.fields(cls)}


def test_every_option_is_explained():
    for path in FOLDER.rglob("*.yaml"):
        for line in path.read_text().splitlines():
            if ":" in line and not line.startswith(("#", "name:", "_target_:", "defaults:")):
                assert "  # " in line, f"{path.name}: {line}"
