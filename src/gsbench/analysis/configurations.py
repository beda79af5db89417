"""The settings of trials and of the arms that gsbench ships, with dotted keys.

Each configuration of an experiment is read once for all trials that share it. The shipped arms are read as plain files
of ``conf/densify``, without composing: what an arm's authors wrote, and where gsbench departs from it, stands in the
comments of its file: lines above the settings, ``theirs: VALUE`` beside one, and facts under fixed keys at the end.
"""

import json
import math
import re
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from gsbench.parsing import DamagedError
from gsbench.runs.keys import NOT_HASHED, flatten
from gsbench.runs.layout import CONFIG
from gsbench.runs.trial_folder import TrialFolder
from gsbench.system.install import conf_dir

ENCODER = json.JSONEncoder(sort_keys=True, separators=(",", ":"))
GROUPS = ("scene", "init", "densify")  # of a configuration: what every trial has


class Configurations:
    """The settings that determine the results of an experiment's trials, read once for all seeds of a trial.

    Those that are ``known`` are not read: of trials that have not run. ``trial`` is the key that seeds share.
    """

    def __init__(self, known: Mapping[str, Mapping[str, Any]] | None = None) -> None:
        self._known: dict[str, Mapping[str, Any]] = dict(known or {})
        self._texts: dict[str, Mapping[str, str]] = {}

    def texts(self, trial: str, folder: Path) -> Mapping[str, str]:
        """The same as `shared`, each as comparable text."""
        if trial not in self._texts:
            self._texts[trial] = {key: canonical(value) for key, value in self.shared(trial, folder).items()}
        return self._texts[trial]

    def shared(self, trial: str, folder: Path) -> Mapping[str, Any]:
        """The settings of the trial in ``folder``, as those of its other seeds; {} where they cannot be read."""
        if trial not in self._known:
            self.find(trial, [folder])
        return self._known[trial]

    def find(self, trial: str, folders: Iterable[Path]) -> str:
        """Read the settings of a trial from the first of ``folders`` that has them; else why the last has not."""
        fault = ""
        for folder in folders:
            try:
                found = load_flat_config(folder)
            except FileNotFoundError:
                fault = f"{CONFIG} is not there"
            except DamagedError as error:
                fault = f"{error.path.name} {error.reason}"
            else:
                own = {key: value for key, value in found.items() if key.split(".")[0] not in NOT_HASHED}
                self._known[trial] = own
                return ""
        self._known.setdefault(trial, {})
        return fault


def load_flat_config(folder: Path) -> dict[str, Any]:
    """The configuration of the trial in ``folder`` with dotted keys; raises FileNotFoundError and DamagedError."""
    values = TrialFolder(folder).settings()
    if not isinstance(values, dict) or not all(isinstance(values.get(group), dict) for group in GROUPS):
        raise DamagedError(folder / CONFIG, f"is damaged: it lacks one of the groups {', '.join(GROUPS)}")
    return flatten(values)


def canonical(value: object) -> str:
    """JSON text that is equal for equal values."""
    if type(value) is int or (type(value) is float and math.isfinite(value)):
        return repr(value)  # as JSON writes it; most settings are such
    return ENCODER.encode(value)


GROUP = "densify"
FACTS = ("Source", "Compared", "Tests", "Otherwise", "Departs from adc by")
FACT = re.compile(rf"^# (?P<key>{'|'.join(FACTS)}): (?P<text>.*(?:\n#   .*)*)$", re.MULTILINE)  # may go on, indented


_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


@cache
def shipped_arms() -> dict[str, Mapping[str, Any]]:
    """The settings of each densifier of gsbench by its name; programs of others are none."""
    return {path.stem: _read(path.stem) for path in sorted((conf_dir() / GROUP).glob("*.yaml"))}


@cache
def facts_of(name: str) -> dict[str, str]:
    """The facts at the end of the file of the shipped arm ``name``, by their key (`FACTS`)."""
    content = (conf_dir() / GROUP / f"{name}.yaml").read_text(encoding="utf-8")
    return {found["key"]: found["text"].replace("\n#   ", " ") for found in FACT.finditer(content)}


@cache
def departures() -> dict[str, tuple[str, ...]]:
    """Ingredients in which each shipped class of densifiers, by its import path, departs from ADC."""
    found = {}
    for name in shipped_arms():
        content = yaml.load((conf_dir() / GROUP / f"{name}.yaml").read_text(encoding="utf-8"), Loader=_LOADER)
        if "_target_" in content:  # a file built on another one is of the other's class
            text = facts_of(name).get("Departs from adc by", "")
            found[content["_target_"]] = tuple(filter(None, text.split(", ")))
    return found


@cache
def _read(name: str) -> dict[str, Any]:
    """An arm's own settings above those of the arms that its list of defaults names."""
    content = yaml.load((conf_dir() / GROUP / f"{name}.yaml").read_text(encoding="utf-8"), Loader=_LOADER)
    parents = [parent for parent in content.pop("defaults", []) if parent != "_self_"]
    return {key: value for parent in parents for key, value in _read(parent).items()} | content
