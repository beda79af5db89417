"""Reading the result files of an experiment: what is complete and sound becomes trials, everything else is named.

A trial lies in ``<runs>/<experiment>/<scene>/<init>-<densify>/<hash8>-seed<k>/``; its ``results.json``, written last,
says that it is complete. Nothing here needs torch, so that tables over thousands of trials come at once.
"""

from __future__ import annotations

import csv
import json
import math
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import yaml

from gsbench.errors import InputError
from gsbench.runs.declaration import QUESTIONS
from gsbench.runs.hashing import BEFORE, flatten
from gsbench.runs.layout import CONFIG, FAILED, IN_RUNS, PER_VIEW, RESULTS
from gsbench.runs.origin import FROM_MODEL, FROM_RENDERS

TRIAL_FOLDER = re.compile(r"(?P<hash>[0-9a-f]{8})-seed(?P<seed>\d+)")
MEAN_TOLERANCE = 1e-6  # relative: per-view values must average to the trial's metric

BY_LISTS = "list"  # of scene.split
Arm = tuple[str, str]  # initialiser, densifier

TEXT_KEYS = ("experiment", "scene", "init", "densify", "raster", "protocol")
COUNT_KEYS = ("seed", "iterations", "num_gaussians")


@dataclass(frozen=True)
class TrialResult:
    """One complete trial; ``data`` is the whole of its ``results.json``, ``config_hash`` that in its folder's name."""

    path: Path
    experiment: str
    scene: str
    init: str
    densify: str
    seed: int
    config_hash: str
    metrics: Mapping[str, float]
    unavailable: Mapping[str, str]
    data: Mapping[str, Any] = field(repr=False)
    variant: str = ""  # the swept settings that tell this trial from others of its initialiser and densifier

    @property
    def arm(self) -> Arm:
        """What is compared: the initialiser, and the densifier with its variant."""
        return self.init, f"{self.densify} {self.variant}".strip()

    @property
    def label(self) -> str:
        """Experiment, scene, arm and folder: enough to find the trial."""
        return f"{self.experiment}/{self.scene}/{self.init}-{self.densify}/{self.path.name}"

    @cached_property
    def config(self) -> dict[str, Any]:
        """The trial's configuration with dotted keys; empty where ``config.yaml`` is absent or cannot be read."""
        try:
            content = yaml.load((self.path / CONFIG).read_text(encoding="utf-8"), Loader=_LOADER)
        except (OSError, UnicodeDecodeError, yaml.YAMLError):
            return {}
        return flatten(content) if isinstance(content, dict) else {}

    @cached_property
    def code(self) -> dict[str, str]:
        """The versions of the code that made the trial; empty for what another program made.

        ``code of <class>`` is the hash of the file that defines a user's own class, ``stage <name>`` the version of
        one of gsbench's stages.
        """
        recorded = self.data.get("code", {})
        return {f"code of {target}": str(digest) for target, digest in recorded.get("sources", {}).items()} | {
            f"stage {name}": str(version) for name, version in recorded.get("stages", {}).items()
        }

    @property
    def finished(self) -> float:
        """When the trial was finished, Unix time."""
        return (self.path / RESULTS).stat().st_mtime

    def conditions(self) -> dict[str, str]:
        """What trials must share before their numbers may be averaged, as comparable text, as far as it is known."""
        known = {
            "protocol": str(self.data["protocol"]),
            "resolution": _size_text(self.data.get("resolution")),
            "data": str(self.data.get("hashes", {}).get("data")),
        }
        if self.split:
            known["split"] = self.split
        if not self.from_renders:
            known["raster"] = str(self.data["raster"])
        if not self.made_elsewhere:
            known["iterations"] = str(self.data["iterations"])
        if not self.made_elsewhere and not self.program:
            known["budget"] = canonical(self.data.get("budget"))
        return known

    @property
    def split(self) -> str:
        """Which views are held out, as short text; "" where it was not recorded, nor is the configuration known."""
        if "split" in self.data:
            return str(self.data["split"])
        return "" if "scene.name" not in self.config else split_text(self.config)

    @property
    def question(self) -> str:
        """What the held-out views ask of a model: interpolation or extrapolation; "" where lists hold them out."""
        kind = re.split("[ ,]", self.split, maxsplit=1)[0]
        return QUESTIONS.get(kind, "")

    @property
    def from_renders(self) -> bool:
        """Whether another program's renders were measured, whose model was not seen."""
        return self.data.get("evaluated_from") == FROM_RENDERS

    @property
    def made_elsewhere(self) -> bool:
        """Whether another program made the model or the renders, in a time and with a budget that nobody knows."""
        return self.data.get("evaluated_from") in (FROM_MODEL, FROM_RENDERS) and not self.program

    @property
    def program(self) -> str:
        """The program that gsbench let train in its place, as it is called; "" where it trained itself, or nobody
        did."""
        found = self.data.get("trained_by")
        return str(found["program"]) if isinstance(found, dict) else ""

    @property
    def budget_acted(self) -> bool:
        """Whether the trial's budget may have changed it: a cap that refused or steers, or a limit of time."""
        if self.made_elsewhere or self.program:
            return False
        budget, events = self.data.get("budget"), self.data.get("events")
        if not isinstance(budget, dict) or not isinstance(events, dict):
            return True
        steered = budget.get("cap") == "governor"
        return steered or budget.get("seconds") is not None or events.get("blocked_by_cap") != 0


@dataclass(frozen=True)
class Experiment:
    """All of an experiment that can be used, and one line for each trial folder that cannot."""

    name: str
    folder: Path
    trials: tuple[TrialResult, ...]
    warnings: tuple[str, ...]

    @property
    def seeds(self) -> tuple[int, ...]:
        return tuple(sorted({trial.seed for trial in self.trials}))


def load_experiment(runs_dir: Path, name: str) -> Experiment:
    """Read every trial of the experiment ``name``; raises ``InputError`` where there is no usable one."""
    experiment = read_experiment(experiment_home(runs_dir, name))
    if not experiment.trials:
        warnings = experiment.warnings
        first = f" (first: {warnings[0]})" if warnings else ""
        raise InputError(
            f"experiment {name!r} has no complete trial among {len(warnings)} folders{first}; run it first"
        )
    return experiment


def read_experiment(folder: Path) -> Experiment:
    """Every trial of the experiment in ``folder``, which may have none yet."""
    runs_dir = folder.parent
    trials: list[TrialResult] = []
    warnings: list[str] = []
    for place in _trial_folders(folder):
        try:
            trials.append(read_trial(Path(place), runs_dir))
        except _UnusableError as reason:
            warnings.append(f"{os.path.relpath(place, runs_dir)}: {reason}")
    trials.sort(key=lambda trial: (trial.scene, trial.init, trial.densify, trial.seed, trial.config_hash))
    return Experiment(folder.name, folder, tuple(trials), tuple(sorted(warnings)))


def list_experiments(runs_dir: Path) -> list[str]:
    """The names of the experiments in a runs folder, sorted."""
    if not runs_dir.is_dir():
        return []
    found = (entry for entry in os.scandir(runs_dir) if entry.is_dir() and not entry.name.startswith("."))
    return sorted(entry.name for entry in found if entry.name not in IN_RUNS)


def experiment_home(runs_dir: Path, name: str) -> Path:
    """The folder of the experiment ``name``; raises InputError naming those there are."""
    known = list_experiments(runs_dir)
    if name not in known:
        raise InputError(f"no experiment {name!r} in {runs_dir}; there: {', '.join(known) or 'none yet'}")
    return runs_dir / name


class _UnusableError(Exception):
    """Why a folder is not a usable trial."""


def read_trial(path: Path, runs_dir: Path) -> TrialResult:
    """Read and check one trial folder."""
    try:
        text = (path / RESULTS).read_text(encoding="utf-8")
    except FileNotFoundError:
        raise _UnusableError(_why_unfinished(path)) from None
    except (OSError, UnicodeDecodeError) as error:
        raise _UnusableError(f"damaged, {RESULTS} cannot be read ({error})") from None
    try:
        data = json.loads(text)
    except json.JSONDecodeError as error:
        raise _UnusableError(f"damaged, {RESULTS} is not JSON ({error})") from None
    _check_content(data)
    match = TRIAL_FOLDER.fullmatch(path.name)
    if match is None:
        raise _UnusableError("foreign, the folder is not named <hash8>-seed<k>")
    experiment, scene, arm = path.relative_to(runs_dir).parts[-4:-1]
    said = {"experiment": data["experiment"], "scene": data["scene"], "arm": f"{data['init']}-{data['densify']}"}
    for (key, value), place in zip(said.items(), (experiment, scene, arm), strict=True):
        if value != place:
            raise _UnusableError(f"foreign, its {RESULTS} is of {key} {value!r}")
    if data["seed"] != int(match["seed"]):
        raise _UnusableError(f"foreign, its {RESULTS} is of seed {data['seed']}")
    return TrialResult(
        path=path,
        experiment=data["experiment"],
        scene=data["scene"],
        init=data["init"],
        densify=data["densify"],
        seed=data["seed"],
        config_hash=match["hash"],
        metrics=data["metrics"],
        unavailable=data.get("unavailable", {}),
        data=data,
    )


def read_views(trial: TrialResult) -> dict[str, dict[str, float]]:
    """The metrics of every test view, ``{view: {metric: value}}``; raises ``InputError`` where the file is damaged.

    The file must average to the trial's own metrics, so that a truncated one cannot pass.
    """
    path = trial.path / PER_VIEW
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        views = {
            row["view"]: {key: float(value) for key, value in row.items() if key != "view" and value != ""}
            for row in rows
        }
    except (OSError, UnicodeDecodeError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is missing or damaged ({error!r}): run `gsbench retry` on it") from None
    for key, expected in trial.metrics.items():
        values = [view[key] for view in views.values() if key in view]
        mean = math.fsum(values) / len(values) if values else math.nan
        if len(values) != len(views) or not math.isclose(
            mean, expected, rel_tol=MEAN_TOLERANCE, abs_tol=MEAN_TOLERANCE
        ):
            raise InputError(
                f"{path} does not average to the {key} of its trial ({mean:.6g}, not {expected:.6g}): damaged"
            )
    return views


def setting(config: Mapping[str, Any], key: str) -> Any:
    """A setting of a configuration with dotted keys; of one older than the setting, what it was before there was it."""
    return config.get(key, BEFORE.get(key))


def split_text(config: Mapping[str, Any]) -> str:
    """``every_nth``, ``sector 0 of 8`` or ``list``, and whether it is matched, or for validation."""
    text, sectors = str(setting(config, "scene.split")), setting(config, "scene.sectors")
    if text == "sector":
        text = f"sector {setting(config, 'scene.sector')} of {sectors}"
    if config.get("scene.train_list") or config.get("scene.test_list"):
        text = BY_LISTS
    elif setting(config, "scene.match_views"):
        text += ", matched" if text.startswith("sector") else f", matched with {sectors}"
    return f"{text}, validation" if setting(config, "scene.validation") else text


def canonical(value: object) -> str:
    """JSON text that is equal for equal values."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"))


_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def _trial_folders(folder: Path) -> Iterator[str]:
    """Every folder three levels below the experiment, in no particular order."""
    for scene in _folders(folder):
        for arm in _folders(scene):
            yield from _folders(arm)


def _folders(place: str | Path) -> list[str]:
    with os.scandir(place) as entries:
        return [entry.path for entry in entries if entry.is_dir() and not entry.name.startswith(".")]


def _why_unfinished(path: Path) -> str:
    try:
        failure = json.loads((path / FAILED).read_text(encoding="utf-8"))
        reason = str(failure.get("message") or failure.get("error") or "see failed.json").strip().splitlines()[-1]
        return f"failed, {reason}"
    except FileNotFoundError:
        return "unfinished, no results.json yet" if (path / CONFIG).is_file() else "foreign, not a trial"
    except (OSError, UnicodeDecodeError, ValueError, AttributeError, IndexError):
        return "failed, and its failed.json is damaged"


def _check_content(data: object) -> None:
    """Raise ``_UnusableError`` unless ``data`` has what every finished trial has, with finite numbers."""
    if not isinstance(data, dict):
        raise _UnusableError(f"damaged, {RESULTS} is not an object")
    if data.get("status") != "complete":
        raise _UnusableError(f"unfinished, its status is {data.get('status')!r}")
    for key in TEXT_KEYS:
        if not isinstance(data.get(key), str):
            raise _UnusableError(f"damaged, {RESULTS} lacks {key!r}")
    for key in COUNT_KEYS:
        if key == "num_gaussians" and data.get("evaluated_from") == FROM_RENDERS:
            continue
        if not isinstance(data.get(key), int) or isinstance(data[key], bool):
            raise _UnusableError(f"damaged, {RESULTS} has no whole number {key!r}")
    for group in ("metrics", "seconds"):
        values = data.get(group)
        if not isinstance(values, dict):
            raise _UnusableError(f"damaged, {RESULTS} lacks {group!r}")
        for key, value in values.items():
            if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
                raise _UnusableError(f"damaged, {group}.{key} is {value!r}")
    for key in ("unavailable", "hashes", "versions"):
        if not isinstance(data.get(key, {}), dict):
            raise _UnusableError(f"damaged, {key!r} is not an object")


def _size_text(size: object) -> str:
    return f"{size[0]}x{size[1]}" if isinstance(size, list | tuple) and len(size) == 2 else str(size)
