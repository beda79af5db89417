"""The settings that determine trials' results, read once for all seeds, and compared as text."""

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from gsbench.parsing import DamagedError, lines_in
from gsbench.runs.config_hash import is_hashed, is_ignored
from gsbench.runs.layout import CONFIG
from gsbench.runs.nested import flatten
from gsbench.runs.trial_folder import TrialFolder

GROUPS = ("scene", "init", "densify")  # groups that every trial's configuration has
ENCODER = json.JSONEncoder(sort_keys=True, separators=(",", ":"))


class Configurations:
    """The settings that determine results, of all trials of an experiment.

    Each file is read once for all seeds. ``trial`` is the key that the seeds of a trial share
    (`TrialResult.key`).
    """

    def __init__(self) -> None:
        self._known: dict[str, Mapping[str, Any]] = {}

    def shared(self, trial: str, folder: Path) -> Mapping[str, Any]:
        """A trial's settings, read from ``folder`` or from an earlier seed; {} if unreadable."""
        if trial not in self._known:
            self.read(trial, [folder])
        return self._known[trial]

    def read(self, trial: str, folders: Iterable[Path]) -> str:
        """Read a trial's settings from its first readable folder; return "", or the last fault."""
        fault = ""
        for folder in folders:
            try:
                config = load_flat_config(folder)
            except FileNotFoundError:
                fault = f"{CONFIG} is not there"
            except DamagedError as error:
                fault = f"{error.path.name} {error.reason}"
            else:
                self._known[trial] = {key: value for key, value in config.items() if is_hashed(key)}
                return ""
        self._known.setdefault(trial, {})
        return fault


def load_flat_config(folder: Path) -> dict[str, Any]:
    """The configuration of the trial in ``folder`` with dotted keys.

    Raises FileNotFoundError and DamagedError.
    """
    values = TrialFolder(folder).settings()
    if not isinstance(values, dict) or not all(
        isinstance(values.get(group), dict) for group in GROUPS
    ):
        raise DamagedError(
            folder / CONFIG, f"is damaged: it lacks one of the groups {', '.join(GROUPS)}"
        )
    settings: dict[str, Any] = lines_in(flatten(values))
    return settings


def config_if_readable(folder: Path) -> Mapping[str, Any]:
    """The same as `load_flat_config`, but {} if the configuration is missing or damaged."""
    try:
        return load_flat_config(folder)
    except (FileNotFoundError, DamagedError):
        return {}


def canonical(value: object) -> str:
    """JSON text that is equal for equal values."""
    if type(value) is int or (type(value) is float and math.isfinite(value)):
        return repr(value)  # the same text as JSON's, but faster: most settings are numbers
    return ENCODER.encode(value)


def settings_text(config: Mapping[str, Any]) -> str:
    """The settings that determine a result, as text that is equal for equal settings."""
    # A missing key counts as unset: trials from before a setting existed equal later ones.
    return canonical(
        {key: value for key, value in config.items() if value is not None and not is_ignored(key)}
    )
