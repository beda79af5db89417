"""The YAML of every initialiser names all options of its class, with its defaults."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
from omegaconf import OmegaConf

import gsbench.init

FILES = sorted((Path(__file__).parents[2] / "conf" / "init").glob("*.yaml"))
FROM_THE_ROOT = {"device": "cpu", "threads": "auto"}


@pytest.mark.parametrize("path", FILES, ids=[path.stem for path in FILES])
def test_yaml_and_class_agree(path: Path):
    root = OmegaConf.create({**FROM_THE_ROOT, "init": OmegaConf.load(path)})
    values = OmegaConf.to_container(root, resolve=True, throw_on_missing=False)["init"]
    module, _, name = values.pop("_target_").rpartition(".")
    assert module == "gsbench.init"
    cls = getattr(gsbench.init, name)
    assert values.pop("name") == cls.name == path.stem
    assert values.keys() == {field.name for field in dataclasses.fields(cls)}
    for field in dataclasses.fields(cls):
        if field.default is not dataclasses.MISSING:  # a required option has no default to agree with
            assert values[field.name] == field.default, field.name


def test_every_option_is_explained():
    for path in FILES:
        for line in path.read_text().splitlines():
            if ":" in line and not line.startswith(("#", "name:", "_target_:")):
                assert "  # " in line, f"{path.name}: {line}"
