"""A complete trial as tables and verdicts see it: its record, settings, code and conditions."""

import json
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from gsbench.parsing import DamagedError, lines_in
from gsbench.runs.commands import Digest, make_digest, shared_hash
from gsbench.runs.configuration import SHOWN, flatten, is_hashed, is_ignored
from gsbench.runs.experiments import QUESTIONS, Arm, unix_time
from gsbench.runs.freshness import Part, code_of
from gsbench.runs.layout import CONFIG, RESULTS
from gsbench.runs.trial_folder import TrialFolder
from gsbench.runs.trial_record import FROM_RENDERS, TrialRecord, split_text
from gsbench.system.machine import kind_of_machine

GROUPS = ("scene", "init", "densify")  # groups that every trial's configuration has
ENCODER = json.JSONEncoder(sort_keys=True, separators=(",", ":"))


# The settings that determine results, of an experiment's trials by `TrialResult.key`, which the
# seeds of a trial share: each file is read once for all seeds.
Configurations = dict[str, Mapping[str, Any]]


def read_configuration(known: Configurations, trial: str, folders: Iterable[Path]) -> str:
    """Read a trial's settings from its first readable folder; return "", or the last fault."""
    fault, known[trial] = "", {}
    for folder in folders:
        try:
            config = load_flat_config(folder)
        except FileNotFoundError:
            fault = f"{CONFIG} is not there"
        except DamagedError as error:
            fault = f"{error.path.name} {error.reason}"
        else:
            known[trial] = {key: value for key, value in config.items() if is_hashed(key)}
            return ""
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
    return lines_in(flatten(values))


def config_if_readable(folder: Path) -> Mapping[str, Any]:
    """The same as `load_flat_config`, but {} if the configuration is missing or damaged."""
    try:
        return load_flat_config(folder)
    except (FileNotFoundError, DamagedError):
        return {}


def seeds_text(seeds: Iterable[int]) -> str:
    """``seed 0`` or ``seeds 0, 1``"""
    shown = [str(seed) for seed in sorted(seeds)]
    return f"seed{'s' * (len(shown) > 1)} {', '.join(shown)}"


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


@dataclass(frozen=True)
class TrialResult:
    """One complete trial.

    ``record`` is its ``results.json``, ``config_hash`` the hash in its folder's name. ``settings``
    reads the configurations of its experiment.
    """

    path: Path
    config_hash: str
    record: TrialRecord = field(repr=False)
    # swept settings that distinguish arms of one initialiser and densifier
    variant: tuple[tuple[str, str], ...] = ()
    settings: Configurations = field(default_factory=dict, repr=False, compare=False)
    alias: Digest = ""  # stands for the digest where a question names its sides otherwise

    @property
    def experiment(self) -> str:
        return self.record.experiment

    @property
    def scene(self) -> str:
        return self.record.scene

    @property
    def init(self) -> str:
        return self.record.init

    @property
    def densify(self) -> str:
        return self.record.densify

    @property
    def seed(self) -> int:
        return self.record.seed

    @property
    def metrics(self) -> Mapping[str, float]:
        """The means of metrics over the test views."""
        return self.record.metrics

    @property
    def unavailable(self) -> Mapping[str, str]:
        """The reasons why metrics are missing."""
        return self.record.unavailable

    @cached_property
    def arm(self) -> Arm:
        """The trial's arm in comparisons."""
        return Arm(self.init, self.densify, self.variant)

    @property
    def label(self) -> str:
        """Experiment, scene, arm and folder: enough to find the trial."""
        return "/".join(self.path.parts[-4:])

    @property
    def config(self) -> Mapping[str, Any]:
        """The settings that determine the result, with dotted keys; empty if unreadable.

        They are read once for all trials that share them; `whole_config` is read from the trial's
        own file.
        """
        if self.key not in self.settings:
            read_configuration(self.settings, self.key, [self.path])
        return self.settings[self.key]

    @cached_property
    def key(self) -> str:
        """The folder in the experiment without the seed, ``<scene>/<init>-<densify>/<hash8>``.

        Trials that differ only in their seeds share it.
        """
        return f"{self.scene}/{self.init}-{self.densify}/{self.config_hash}"

    @cached_property
    def whole_config(self) -> Mapping[str, Any]:
        """Every setting with dotted keys, also those that change no result; empty if unreadable."""
        return config_if_readable(self.path)

    @cached_property
    def folder(self) -> TrialFolder:
        """The files of the trial."""
        return TrialFolder(self.path)

    @cached_property
    def code(self) -> dict[Part, str]:
        """The versions of the code that made the trial; empty if another program made it."""
        return code_of(self.record.code)

    @cached_property
    def digest(self) -> Digest:
        """The digest of its arm on its scene: settings, user's modules, edited packages."""
        if self.alias:
            return self.alias
        code = self.record.code
        arm, config_hash = f"{self.init}-{self.densify}", self.config_hash
        if self.from_renders and not self.program:
            config_hash = shared_hash(config_hash, self.folder.settings()["densify"])
        return make_digest(arm, config_hash, code.sources, code.packages)

    @property
    def code_texts(self) -> list[str]:
        """``code of mine 3fa9c1d2`` for each of the user's modules and of gsbench's stages."""
        shown = [part for part in self.code if part.kind != "package"]
        return [f"{part} {self.code[part]:.{SHOWN}}" for part in shown]

    @cached_property
    def finished(self) -> float:
        """The Unix time at which the trial was finished; if unrecorded, that of the file.

        A copy of the folder may have other times of its files.
        """
        made_of = self.folder.made_of()
        return (made_of and made_of.finished) or (self.path / RESULTS).stat().st_mtime

    @cached_property
    def machine(self) -> str | None:
        """The kind of machine that trained the trial, in a phrase; None if it was not recorded."""
        try:
            return None if self.record.machine is None else kind_of_machine(self.record.machine)
        except KeyError:
            return None

    @property
    def cloud(self) -> str:
        """The hash of the initial model's files (cameras, poses, points); "" if unrecorded."""
        return self.record.hashes.get("cloud", "")

    @cached_property
    def measured(self) -> float:
        """The Unix time of measuring the metrics; if unrecorded, that of finishing the trial."""
        moment = unix_time(self.record.measured)
        return self.finished if moment is None else moment

    @cached_property
    def conditions(self) -> Mapping[str, str]:
        """The conditions that trials must share before they are averaged, as text."""
        conditions = {
            "protocol": self.record.protocol,
            "resolution": "x".join(map(str, self.record.resolution or (None,))),
            "data": str(self.record.hashes.get("data")),
        }
        if self.split:
            conditions["split"] = self.split
        if not self.from_renders:
            conditions["raster"] = self.record.raster
        if not self.made_elsewhere:
            budget, iterations = self.record.budget, self.record.iterations
            if budget is not None and budget.seconds is not None:
                # A time limit ends each training at another one: the planned number must agree.
                iterations = self.config.get("train.iterations", iterations)
            conditions["iterations"] = str(iterations)
        if not self.made_elsewhere and not self.program:
            conditions["budget"] = (
                "null" if self.record.budget is None else canonical(asdict(self.record.budget))
            )
        return conditions

    @cached_property
    def split(self) -> str:
        """The rule that holds views out, as short text; "" if nothing tells it."""
        if self.record.split:
            return self.record.split
        return split_text(self.config) if self.config.get("scene.split") else ""

    @cached_property
    def question(self) -> str:
        """The question of the held-out views, interpolation or extrapolation; "" for a list."""
        kind = re.split("[ ,]", self.split, maxsplit=1)[0]
        return QUESTIONS.get(kind, "")

    @property
    def from_renders(self) -> bool:
        """Return whether another program's renders were measured, without its model."""
        return self.record.evaluated_from == FROM_RENDERS

    @property
    def made_elsewhere(self) -> bool:
        """Return whether model or renders come from elsewhere: no time or budget is known."""
        return self.record.evaluated_from is not None and not self.program

    @property
    def program(self) -> str:
        """The name of the program that gsbench ran to train this trial; "" if gsbench ran none."""
        return "" if self.record.trained_by is None else self.record.trained_by.program

    @property
    def trainer_version(self) -> str:
        """The version of `program`; "" without one."""
        return "" if self.record.trained_by is None else self.record.trained_by.version

    @property
    def budget_acted(self) -> bool:
        """Return whether a cap on Gaussians or a time limit may have changed the result."""
        if self.made_elsewhere or self.program:
            return False
        budget, events = self.record.budget, self.record.events
        if budget is None or not events:
            return True
        return (
            budget.cap == "governor"
            or budget.seconds is not None
            or events.get("blocked_by_cap") != 0
        )


@dataclass(frozen=True)
class Planned:
    """A planned trial as far as questions depend on it.

    ``config`` has the settings with dotted keys, ``variant`` those that were swept.
    """

    scene: str
    init: str
    densify: str
    config_hash: str
    seed: int
    config: Mapping[str, Any] = field(repr=False)
    digest: Digest
    variant: tuple[tuple[str, str], ...] = ()

    @property
    def key(self) -> str:
        return f"{self.scene}/{self.init}-{self.densify}/{self.config_hash}"

    @property
    def arm(self) -> Arm:
        return Arm(self.init, self.densify, self.variant)


Trained = Planned | TrialResult  # or to be trained
