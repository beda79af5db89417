"""The arms that gsbench ships, as ``conf/densify`` states them: read as plain files, without composing."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache
from typing import Any

import yaml

from gsbench.system.install import conf_dir

GROUP = "densify"
REFERENCE = re.compile(r"\$\{([\w.]+)\}")  # the value of another key


@cache
def shipped_arms() -> dict[str, Mapping[str, Any]]:
    """The settings of each densifier of gsbench by its name; programs of others are none."""
    return {path.stem: _read(path.stem) for path in sorted((conf_dir() / GROUP).glob("*.yaml"))}


def resolved(settings: Mapping[str, Any], config: Mapping[str, Any]) -> dict[str, Any]:
    """``settings`` of a densifier with dotted keys, as they would be in a trial with the configuration ``config``."""
    found = {}
    for key, value in settings.items():
        named = REFERENCE.fullmatch(value) if isinstance(value, str) else None
        found[f"{GROUP}.{key}"] = value if named is None else config.get(named[1])
    return found


@cache
def _read(name: str) -> dict[str, Any]:
    """An arm's own settings above those of the arms that its list of defaults names."""
    content = yaml.safe_load((conf_dir() / GROUP / f"{name}.yaml").read_text(encoding="utf-8"))
    parents = [parent for parent in content.pop("defaults", []) if parent != "_self_"]
    return {key: value for parent in parents for key, value in _read(parent).items()} | content
