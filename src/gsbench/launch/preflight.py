"""Checks before any trial starts: wrong options of components, folders and devices that are not there."""

from __future__ import annotations

import importlib.util
import re
import shutil
from collections.abc import Sequence
from pathlib import Path

from gsbench.config.command_words import options
from gsbench.config.compose import Trial
from gsbench.config.schema import COMPONENTS
from gsbench.errors import InputError
from gsbench.runs.code import OWN
from gsbench.system.install import install_command
from gsbench.words import counted, readable_bytes

BYTES_OF_GAUSSIAN = 248  # in a PLY
LARGE_SHARE = 0.1  # of the free disk


def missing_folders(trials: Sequence[Trial]) -> list[str]:
    """A line for each folder of photographs, model or weights that trials name and that is not there, and the mend."""
    from gsbench.datasets.catalog import how_to_get
    from gsbench.scene.readers import missing_folder, missing_model

    given = [scene for scene in (trial.values["scene"] for trial in trials) if scene["kind"] != "courtyard"]
    scenes = {(scene["name"], scene["path"]) for scene in given}
    folders = [(name, Path(path).expanduser()) for name, path in sorted(scenes, key=str)]
    missing = [(name, folder) for name, folder in folders if not folder.is_dir()]
    lines = [missing_folder(name, folder) for name, folder in missing]
    models = {(scene["name"], scene["path"], scene["sparse"]) for scene in given if scene["kind"] == "colmap"}
    for name, path, sparse in sorted(models, key=str):
        if (root := Path(path).expanduser()).is_dir() and (line := missing_model(name, root, sparse)):
            lines.append(line)
    return lines + ([how_to_get(missing)] if missing else []) + missing_weights(trials)


def missing_weights(trials: Sequence[Trial]) -> list[str]:
    """A line for each folder of weights that the trials name and that is not there."""
    named = {
        (group, str(folder))
        for group in ("eval", "init")
        for folder in (trial.values[group].get("weights") for trial in trials)
        if folder is not None
    }
    return [
        f"{group}.weights={folder}: no such folder; without it, weights are looked for where gsbench keeps them"
        for group, folder in sorted(named)
        if not Path(folder).expanduser().is_dir()
    ]


def disk_line(trials: Sequence[Trial]) -> str:
    """Say how much disk the models of trials may take, where that is a good part of what is free; else ""."""
    most = sum(BYTES_OF_GAUSSIAN * (trial.values["densify"].get("max_gaussians") or 0) for trial in trials)
    if not most:
        return ""
    runs = trials[0].files.runs
    free = shutil.disk_usage(next(place for place in (runs, *runs.parents) if place.exists())).free
    said = f"disk: up to {readable_bytes(most)} for the models of {counted(len(trials), 'trial')}"
    return f"{said}, {readable_bytes(free)} are free in {runs}" if most > free * LARGE_SHARE else ""


def check_parts(trials: Sequence[Trial], here: bool) -> None:
    """Refuse what the parts of the trials do not take.

    With ``here``, the trials will run on this machine, whose devices are known. Raises InputError naming the key.
    """
    from gsbench.pipeline.parts import Parts

    for trial in trials:
        Parts(trial.values).check(here)


def check_trackers(trials: Sequence[Trial]) -> None:
    """Raise InputError where a trial's tracker needs a package that is not installed."""
    for sink in sorted({t.values["tracking"]["sink"] for t in trials if t.values["tracking"]["enabled"]}):
        if importlib.util.find_spec(sink) is None:
            raise InputError(f"tracking.sink={sink} needs a package: {install_command(sink)} (or pip install {sink})")


def borrowed_names(trials: Sequence[Trial]) -> list[str]:
    """A line for each class of the user's that would be shown under the name of one of gsbench's own."""
    named = {
        (group, str(part.get("name")), str(part["_target_"]))
        for trial in trials
        for group, part in ((group, trial.values[group]) for group in ("densify", "init"))
        if part.get("_target_") is not None and not str(part["_target_"]).startswith(OWN)
    }
    return [
        f"{target} is shown as {name}, like gsbench's own: "
        f"give it a name, {group}.name={target.rpartition('.')[2].lower()}"
        for group, name, target in sorted(named)
        if name in options(group)
    ]


def need_no_check(trials: Sequence[Trial]) -> bool:
    """Return whether the trials take their components as they ship, whose options gsbench's own tests have checked.

    A dry run then answers without loading torch.
    """
    for word in {word for trial in trials for word in trial.overrides}:
        key, _, value = word.lstrip("+~").partition("=")
        group = re.split("[./@]", key)[0]
        if group == "hydra" or (group in (*COMPONENTS, "raster", "train") and value not in options(key)):
            return False
    return True
