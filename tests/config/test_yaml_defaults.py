"""Each default has one source: the dataclass of a group, or the class that a file names."""

import pytest
import yaml

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
