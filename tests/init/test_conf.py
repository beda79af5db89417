"""The YAML files of initialisers have all options and defaults of the classes."""

import dataclasses
from pathlib import Path

import pytest

import gsbench.init
from gsbench.config.compose import compose_one

FOLDER = Path(__file__).parents[2] / "conf" / "init"
NAMES = sorted(path.stem for path in FOLDER.glob("*.yaml"))
REQUIRED = {"ply": ["init.path=a.ply"], "points": ["init.path=a.ply"]}
# presets: a class under another name, with other values than its defaults
DELIBERATE = {
    "dim_paper": {"pairs": "lowres", "max_keypoints": 4096, "min_inlier_ratio": 0.25},
    "sfm_preview": {
        "pairs": "auto",
        "max_image_size": 1000,
        "max_num_features": 4096,
        "first_octave": 0,
    },
}


def composed(name):
    """The settings of the initialiser as a trial gets them."""
    return compose_one([f"init={name}", "scene=courtyard", *REQUIRED.get(name, [])]).values["init"]


@pytest.mark.parametrize("name", NAMES)
def test_yaml_and_class_agree(name):
    values = composed(name)
    module, _, class_name = values.pop("_target_").rpartition(".")
    assert module == "gsbench.init"
    cls = getattr(gsbench.init, class_name)
    assert values.pop("name") == name
    assert name in DELIBERATE or cls.name == name
    assert values.keys() == {field.name for field in dataclasses.fields(cls)}
    own = {"device": "auto", **DELIBERATE.get(name, {})}
    for field in dataclasses.fields(cls):
        # a required option has no default to agree with
        if field.default is not dataclasses.MISSING:
            assert values[field.name] == own.get(field.name, field.default), field.name


def test_every_option_is_explained():
    for path in FOLDER.rglob("*.yaml"):
        for line in path.read_text().splitlines():
            if ":" in line and not line.startswith(("#", "name:", "_target_:", "defaults:")):
                assert "  # " in line, f"{path.name}: {line}"
