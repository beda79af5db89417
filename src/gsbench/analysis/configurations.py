"""The settings of trials, with dotted keys, each configuration of an experiment read once for all that share it."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from gsbench.parsing import DamagedError
from gsbench.runs.hashing import NOT_HASHED, flatten
from gsbench.runs.layout import CONFIG
from gsbench.runs.trial_folder import TrialFolder

ENCODER = json.JSONEncoder(sort_keys=True, separators=(",", ":"))
GROUPS = ("scene", "init", "densify")  # of a configuration: what every trial has

Kind = tuple[str, str, str, str]  # scene, initialiser, densifier, hash of the configuration


class Configurations:
    """The settings that determine the results of an experiment's trials, read once for all of one kind.

    Those that are ``known`` are not read: of trials that have not run.
    """

    def __init__(self, known: Mapping[Kind, Mapping[str, Any]] | None = None) -> None:
        self._known: dict[Kind, Mapping[str, Any]] = dict(known or {})
        self._texts: dict[Kind, Mapping[str, str]] = {}

    def texts(self, kind: Kind, folder: Path) -> Mapping[str, str]:
        """The same as `shared`, each as comparable text."""
        if kind not in self._texts:
            self._texts[kind] = {key: canonical(value) for key, value in self.shared(kind, folder).items()}
        return self._texts[kind]

    def shared(self, kind: Kind, folder: Path) -> Mapping[str, Any]:
        """The settings of the trial in ``folder``, as those of any other of its ``kind``; {} where unreadable."""
        if kind not in self._known:
            self.find(kind, [folder])
        return self._known[kind]

    def find(self, kind: Kind, folders: Iterable[Path]) -> str:
        """Read the settings of a kind from the first of ``folders`` that has them; else why the last has not."""
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
                self._known[kind] = own
                return ""
        self._known.setdefault(kind, {})
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
