"""Write the defaults of the classes that ``conf/`` names, so that Hydra knows them without torch.

    python scripts/class_defaults.py    write src/gsbench/config/class_defaults.json

A class has the options that it adds to its nearest base class in the file, and those whose defaults
differ. The YAML of an arm names the class's defaults, ``/schema/densify/ADC@_here_``, and states
only its name, its class, references to other settings, and what it changes.
"""

from __future__ import annotations

import dataclasses
import importlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from gsbench.config.schema import CLASS_DEFAULTS
from gsbench.settings import MISSING, option_fields

CONF = Path(__file__).resolve().parents[1] / "conf"
GROUPS = ("densify", "init")


def main() -> None:
    text = json.dumps(class_defaults(), indent=1)
    CLASS_DEFAULTS.write_text(text + "\n", encoding="utf-8")


def class_defaults() -> dict[str, dict[str, dict[str, Any]]]:
    """The options of each class by group and name, as the file has them."""
    return {group: of_group(sorted(set(classes_of(group)), key=str)) for group in GROUPS}


def classes_of(group: str) -> Iterator[type]:
    """The dataclasses that the files of a group name as ``_target_``."""
    for file in sorted((CONF / group).glob("*.yaml")):
        content = yaml.safe_load(file.read_text(encoding="utf-8")) or {}
        module, _, name = str(content.get("_target_", "")).rpartition(".")
        if module:
            cls = getattr(importlib.import_module(module), name)
            if dataclasses.is_dataclass(cls):
                yield cls


def of_group(classes: list[type]) -> dict[str, dict[str, Any]]:
    found = {}
    for cls in classes:
        base = next((one for one in cls.__mro__[1:] if one in classes), None)
        known = defaults_of(base) if base else {}
        own = defaults_of(cls)
        found[cls.__name__] = {
            key: value for key, value in own.items() if key not in known or known[key] != value
        }
    return found


def defaults_of(cls: type) -> dict[str, Any]:
    """The default of each option, in the types of JSON; ``???`` if there is none."""
    defaults: dict[str, Any] = {}
    for entry in option_fields(cls):
        if entry.default_factory is not dataclasses.MISSING:
            defaults[entry.name] = entry.default_factory()
        else:
            has_none = entry.default is dataclasses.MISSING
            defaults[entry.name] = MISSING if has_none else entry.default
    plain: dict[str, Any] = json.loads(json.dumps(defaults))
    return plain


if __name__ == "__main__":
    main()
