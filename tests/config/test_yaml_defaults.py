"""Each default has one source: the dataclass of a group, or the class that a file names."""

import pytest
import yaml

from gsbench.config.compose import compose_one
from gsbench.config.schema import CLASS_DEFAULTS, GROUP_SCHEMAS
from gsbench.settings import option_fields
from gsbench.system.install import conf_dir
from tests.conftest import script
from tests.helpers import read_json

class_defaults = script("class_defaults")
GROUPS = ("densify", "eval", "init", "launch", "raster", "scene", "tracking", "train")
# keys that tell the files of a group apart
NAMES = ("name", "kind", "protocol", "path", "_target_", "enabled", "defaults")
FILES = [f"{g}/{file.stem}" for g in GROUPS for file in sorted((conf_dir() / g).glob("*.yaml"))]


def test_the_defaults_of_classes_are_current():
    """To write them anew: python scripts/class_defaults.py"""
    assert read_json(CLASS_DEFAULTS) == class_defaults.class_defaults()


CLASSES = [
    (group, cls) for group in class_defaults.GROUPS for cls in class_defaults.classes_of(group)
]
REQUIRED = {"Ply": ["init.path=a.ply"], "Points": ["init.path=a.ply"]}


@pytest.mark.parametrize("group,cls", CLASSES, ids=[cls.__name__ for _, cls in CLASSES])
def test_a_composed_choice_has_each_option_of_its_class(group, cls):
    names = [f for f in FILES if f.startswith(f"{group}/") and _target(f) == cls.__name__]
    words = ["scene=courtyard", names[0].replace("/", "="), *REQUIRED.get(cls.__name__, [])]
    values = compose_one(words).values[group]
    options = {option.name: getattr(cls, option.name, None) for option in option_fields(cls)}
    assert values.keys() - {"name", "_target_"} == options.keys()


@pytest.mark.parametrize("path", FILES)
def test_a_file_states_no_default_again(path):
    """Without a key that a file states, other values are composed, or the same by a reference."""
    group, _ = path.split("/")
    stated = _read(path)
    known = _known(group, stated.get("defaults", []))
    for key, value in stated.items():
        if key not in NAMES and not str(value).startswith(("${", "???")):
            assert key not in known or known[key] != value, key


def _read(path):
    content = yaml.safe_load((conf_dir() / f"{path}.yaml").read_text(encoding="utf-8"))
    return content if isinstance(content, dict) else {}


def _target(path):
    return str(_read(path).get("_target_", "")).rpartition(".")[2]


def _known(group, base):
    """The values that a file would have without its own: of files and classes it is built on."""
    found = {}
    for entry in base:
        name = str(entry).removesuffix("@_here_")
        if name.startswith("/schema/"):
            _, _, group_of_class, cls = name.split("/")
            found |= read_json(CLASS_DEFAULTS)[group_of_class][cls]
        elif name != "_self_" and not name.startswith("/"):
            parent = _read(f"{group}/{name}")
            found |= _known(group, parent.get("defaults", [])) | parent
    if group in class_defaults.GROUPS:
        return found
    schema = GROUP_SCHEMAS[group]
    return {o.name: o.default for o in option_fields(schema)} | found
