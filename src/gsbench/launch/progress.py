"""The progress of a sweep: the trials of each arm by state, speed and time left."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING

from gsbench.analysis.results import TrialResult, read_experiment
from gsbench.errors import InputError
from gsbench.launch.states import STATES, TrialState, arm_names, states_of_experiment
from gsbench.runs.experiments import experiment_home
from gsbench.runs.layout import CURVES
from gsbench.runs.trial_files import read_rows
from gsbench.runs.trial_folder import TrialFolder

if TYPE_CHECKING:
    import pandas as pd

SPEED = "iterations_per_second"
Name = tuple[str, str]  # arm, scene


def progress_frame(runs: Path, experiment: str) -> pd.DataFrame:
    """A row for each arm of an experiment, as ``gsbench status --watch`` shows it.

    Its columns are done, running, failed, waiting (numbers of trials) and iterations_per_second (of
    running trainings). ``attrs`` has seconds_left, which is None as long as no trial is done.
    Raises InputError for an unknown experiment.
    """
    import pandas as pd

    home = experiment_home(runs, experiment)
    # A superseded trial will never be done, so with it no sweep would end.
    found = read_experiment(home)
    states = [one for one in states_of_experiment(home, found) if one.state != "superseded"]
    names = {path: (arm, path.parents[1].name) for path, arm in arm_names(states).items()}
    columns: dict[str, float] = {"done": 0, "running": 0, "failed": 0, "waiting": 0, SPEED: 0.0}
    rows = {arm: columns.copy() for arm in sorted({arm for arm, _ in names.values()})}
    for state in states:
        row = rows[names[state.folder][0]]
        row[STATES[state.state].column] += 1
        if state.state == "running":
            row[SPEED] += _speed(TrialFolder(state.folder))
    frame = pd.DataFrame.from_dict(rows, orient="index", columns=[*columns])
    done = [trial for trial in found.trials if trial.path in names]
    frame.attrs["seconds_left"] = _seconds_left(states, names, done)
    return frame


def _speed(files: TrialFolder) -> float:
    """The iterations per second of the present training; 0 without one."""
    building = files.building()
    file = Path(building.folder, CURVES) if building.folder else None
    rows = read_rows(file) if file is not None and file.exists() else []
    seconds = float(rows[-1].get("seconds", 0.0)) if rows else 0.0
    return float(rows[-1]["step"]) / seconds if seconds > 0 else 0.0


def _kinds(name: Name) -> tuple[Name, ...]:
    """The keys of trials that tell how long one takes: its arm and scene, its arm, all."""
    return name, (name[0], ""), ("", "")


def _seconds_left(
    states: Sequence[TrialState], names: Mapping[Path, Name], done: Sequence[TrialResult]
) -> float | None:
    """The seconds until all trials have ended, if as many run at once as now.

    A trial takes as long as the finished ones of its arm and scene, else of its arm, else of all.
    """
    known: dict[Name, list[float]] = defaultdict(list)
    for trial in done:
        for kind in _kinds(names[trial.path]):
            known[kind].append(sum(trial.record.seconds.values()))
    if not known:
        return None
    total = 0.0
    for state in states:
        if state.state in ("done", "failed"):
            continue
        similar = next(known[kind] for kind in _kinds(names[state.folder]) if kind in known)
        share, files = 0.0, TrialFolder(state.folder)
        if state.state == "running":
            with suppress(InputError, KeyError, TypeError):
                share = files.share_done(files.configuration()["train"]["iterations"])
        total += fmean(similar) * (1 - share)
    return total / max(1, sum(state.state == "running" for state in states))
