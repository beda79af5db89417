"""The settings of trials (with dotted keys) and of the arms that gsbench ships.

Trials that share a configuration read it once. The shipped arms are read as plain files of ``conf/densify``, without
Hydra. The comments of such a file state what the arm's authors wrote and where gsbench departs from it: lines above the
settings, ``theirs: VALUE`` beside a setting, and facts under fixed keys at the end (`FACTS`).
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
GROUPS = ("scene", "init", "densify")  # groups that every trial's configuration has


class Configurations:
    """The settings that determine results, of all trials of an experiment. Each file is read once for all seeds.

    ``trial`` is the key that the seeds of a trial share (`TrialResult.key`). ``known`` has, by this key, the settings
    of trials that have not run and thus have no file.
    """

    def __init__(self, known: Mapping[str, Mapping[str, Any]] | None = None) -> None:
        self._known: dict[str, Mapping[str, Any]] = dict(known or {})
        self._texts: dict[str, Mapping[str, str]] = {}

    def texts(self, trial: str, folder: Path) -> Mapping[str, str]:
        """The settings of `shared` as text that is equal for equal values."""
        if trial not in self._texts:
            self._texts[trial] = {key: canonical(value) for key, value in self.shared(trial, folder).items()}
        return self._texts[trial]

    def shared(self, trial: str, folder: Path) -> Mapping[str, Any]:
        """The settings of a trial, read from ``folder`` or from another seed before; {} if they cannot be read."""
        if trial not in self._known:
            self.read(trial, [folder])
        return self._known[trial]

    def read(self, trial: str, folders: Iterable[Path]) -> str:
        """Read the settings of a trial from its first readable folder; return "", or the last folder's fault."""
        fault = ""
        for folder in folders:
            try:
                config = load_flat_config(folder)
            except FileNotFoundError:
                fault = f"{CONFIG} is not there"
            except DamagedError as error:
                fault = f"{error.path.name} {error.reason}"
            else:
                hashed = {key: value for key, value in config.items() if key.split(".")[0] not in NOT_HASHED}
                self._known[trial] = hashed
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
        return repr(value)  # the same text as JSON's, but faster: most settings are numbers
    return ENCODER.encode(value)


FACTS = ("Source", "Compared", "Tests", "Otherwise", "Departs from adc by")
# A fact is one comment line; indented comment lines continue it.
FACT = re.compile(rf"^# (?P<key>{'|'.join(FACTS)}): (?P<text>.*(?:\n#   .*)*)$", re.MULTILINE)

_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


@cache
def shipped_arms() -> dict[str, Mapping[str, Any]]:
    """The settings of each densifier that gsbench ships, by name, without ``densify/external``."""
    return {path.stem: _with_defaults(path.stem) for path in sorted(_arms_folder().glob("*.yaml"))}


@cache
def facts_of(name: str) -> dict[str, str]:
    """The facts at the end of the file of the shipped arm ``name``, by their key (`FACTS`)."""
    content = (_arms_folder() / f"{name}.yaml").read_text(encoding="utf-8")
    return {match["key"]: match["text"].replace("\n#   ", " ") for match in FACT.finditer(content)}


@cache
def departures() -> dict[str, tuple[str, ...]]:
    """The ingredients in which each shipped densifier class (by import path) departs from ADC."""
    by_class = {}
    for name in shipped_arms():
        content = _own_settings(name)
        if "_target_" in content:  # without it, the arm has the class of the arm in its defaults
            text = facts_of(name).get("Departs from adc by", "")
            by_class[content["_target_"]] = tuple(filter(None, text.split(", ")))
    return by_class


@cache
def _with_defaults(name: str) -> dict[str, Any]:
    """The settings of an arm, which override those of the arms in its ``defaults``."""
    content = _own_settings(name)
    parents = [parent for parent in content.pop("defaults", []) if parent != "_self_"]
    return {key: value for parent in parents for key, value in _with_defaults(parent).items()} | content


def _own_settings(name: str) -> dict[str, Any]:
    settings: dict[str, Any] = yaml.load((_arms_folder() / f"{name}.yaml").read_text(encoding="utf-8"), Loader=_LOADER)
    return settings


def _arms_folder() -> Path:
    return conf_dir() / "densify"
