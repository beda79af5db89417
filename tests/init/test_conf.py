"""The YAML of every initialiser, composed: all options of its class with its defaults, as in the first version."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest

import gsbench.init
from gsbench.config.compose import compose_one
from gsbench.runs.hashing import sha256_of, without_later

FOLDER = Path(__file__).parents[2] / "conf" / "init"
NAMES = sorted(path.stem for path in FOLDER.glob("*.yaml"))
REQUIRED = {"ply": ["init.path=a.ply"], "points": ["init.path=a.ply"]}
# presets: a class under another name, with other values than its defaults
DELIBERATE: dict[str, dict[str, Any]] = {
    "dim_paper": {"pairs": "lowres", "max_keypoints": 4096, "min_inlier_ratio": 0.25},
    "sfm_preview": {"pairs": "auto", "max_image_size": 1000, "max_num_features": 4096, "first_octave": 0},
}
# sha256 of the group as the first version composed it, when each file still named all of its options
FIRST = {
    "dataset": "76fad1aa8d9e900c14b239716654f3a0a30b1a1dce3b4459064bbd7055a6f4b0",
    "dim": "1199d2907edd6b914ae23462c0adedb6bc5d136cf68f27971fae158658c8789d",
    "ply": "486fc09e0a5126f6d1f575b7ad18716cd6b803bcfdc40e9af23a6452bc2dd3d2",
    "random": "b6460921ca00d028598640b1e0225fcb882abcf690f890cbc8c06b9884f0e4f4",
    "sfm": "deaad9da45dc9eb1a063bb3c743cbbe69b4a724c327b15178efb7315bac5e86a",
    "sfm_dense": "954546de1b57d455ec9651a28f2477d002e705ff1e84a186ee04c7e731f5abab",
    "sift_kornia": "a77ec15b253b2719fc724e8fbc71582e75c78464d390b3f2c7ce6d851c882862",
}


def composed(name: str) -> dict[str, Any]:
    """The group as a trial gets it, without settings that are younger than the first version, at their defaults."""
    return compose_one([f"init={name}", "scene=courtyard", *REQUIRED.get(name, [])]).values["init"]


@pytest.mark.parametrize("name", NAMES)
def test_yaml_and_class_agree(name: str):
    values = composed(name)
    module, _, class_name = values.pop("_target_").rpartition(".")
    assert module == "gsbench.init"
    cls = getattr(gsbench.init, class_name)
    assert values.pop("name") == name
    assert name in DELIBERATE or cls.name == name
    assert values.keys() == {field.name for field in dataclasses.fields(cls)}
    own = {"device": "auto", **DELIBERATE.get(name, {})}
    for field in dataclasses.fields(cls):
        if field.default is not dataclasses.MISSING:  # a required option has no default to agree with
            assert values[field.name] == own.get(field.name, field.default), field.name


@pytest.mark.parametrize("name", FIRST)
def test_the_composed_group_is_what_it_was(name: str):
    """Results of the first version are found again only if not a single value changed."""
    assert sha256_of(without_later("init", composed(name))) == FIRST[name]


def test_every_option_is_explained():
    for path in FOLDER.rglob("*.yaml"):
        for line in path.read_text().splitlines():
            if ":" in line and not line.startswith(("#", "name:", "_target_:", "defaults:")):
                assert "  # " in line, f"{path.name}: {line}"
