"""The progress of a sweep: states by arm and scene, speed, time left and leading arm."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING

from gsbench.analysis.quantities import Quantity, asked_quantity
from gsbench.analysis.results import Experiment, TrialResult, newest_code, read_experiment
from gsbench.errors import InputError
from gsbench.launch.states import TrialState, names_of, states_of_experiment
from gsbench.runs.experiments import experiment_home
from gsbench.runs.layout import CURVES
from gsbench.runs.rows import read_rows
from gsbench.runs.trial_folder import TrialFolder

if TYPE_CHECKING:
    import pandas as pd

Name = tuple[str, str]  # arm, scene
COUNTED = ("done", "running", "failed")  # all other states are waiting
WAITING = "waiting"


@dataclass(frozen=True)
class Progress:
    """The progress of a sweep.

    ``cells`` has the number of trials by (arm, scene) and state (`COUNTED` or ``waiting``),
    ``speeds`` the iterations per second of running trainings. ``seconds_left`` is None as long as
    no trial is done. ``leader`` says which arm is best so far; "" if that cannot be said.
    """

    cells: dict[Name, dict[str, int]]
    speeds: dict[Name, float]
    seconds_left: float | None
    leader: str

    @property
    def has_ended(self) -> bool:
        """Return whether no trial runs or waits."""
        return not any(cell["running"] + cell[WAITING] for cell in self.cells.values())


def progress_frame(runs: Path, experiment: str) -> pd.DataFrame:
    """A row for each arm and scene of an experiment, as ``gsbench status --watch`` shows it.

    Its columns are arm, scene, done, running, failed, waiting (numbers of trials) and
    iterations_per_second (of running trainings, else 0). ``attrs`` has seconds_left and leader.
    Raises InputError for an unknown experiment.
    """
    import pandas as pd

    found = progress_of(experiment_home(runs, experiment))
    rows = [
        {
            "arm": arm,
            "scene": scene,
            **cell,
            "iterations_per_second": found.speeds.get((arm, scene), 0.0),
        }
        for (arm, scene), cell in found.cells.items()
    ]
    frame = pd.DataFrame(rows)
    frame.attrs |= {"seconds_left": found.seconds_left, "leader": found.leader}
    return frame


def progress_of(home: Path) -> Progress:
    """The progress of the experiment in ``home``, from its files."""
    # A superseded trial will never be done, so with it no sweep would end.
    states = [state for state in states_of_experiment(home) if state.state != "superseded"]
    names = names_of(states)
    cells: dict[Name, dict[str, int]] = {
        name: dict.fromkeys((*COUNTED, WAITING), 0) for name in sorted(names.values())
    }
    speeds: dict[Name, float] = defaultdict(float)
    for state in states:
        cells[names[state.folder]][state.state if state.state in COUNTED else WAITING] += 1
        if state.state == "running":
            speeds[names[state.folder]] += _training(state.folder)[1]
    experiment = newest_code(read_experiment(home))
    shown = tuple(trial for trial in experiment.trials if trial.path in names)
    left = _seconds_left(states, names, shown)
    leader = _leader(replace(experiment, trials=shown), names)
    return Progress(cells, dict(speeds), left, leader)


def _kinds(name: Name) -> tuple[Name, ...]:
    """The keys of trials that tell how long one takes: its arm and scene, its arm, all."""
    return name, (name[0], ""), ("", "")


def _training(folder: Path) -> tuple[int, float]:
    """The last iteration of the present training, and iterations per second; else zeros."""
    building = TrialFolder(folder).building()
    file = Path(building.folder, CURVES) if building.folder else None
    rows = read_rows(file) if file is not None and file.exists() else []
    if not rows:
        return 0, 0.0
    step, seconds = int(rows[-1]["step"]), float(rows[-1].get("seconds", 0.0))
    return step, step / seconds if seconds > 0 else 0.0


def _seconds_left(
    states: Sequence[TrialState], names: dict[Path, Name], trials: Sequence[TrialResult]
) -> float | None:
    """The seconds until all trials have ended, if as many run at once as now.

    A trial takes as long as the finished ones of its arm and scene, else of its arm, else of all.
    """
    known: dict[Name, list[float]] = defaultdict(list)
    for trial in trials:
        for kind in _kinds(names[trial.path]):
            known[kind].append(sum(trial.record.seconds.values()))
    if not known:
        return None
    total = 0.0
    for state in states:
        if state.state in ("done", "failed"):
            continue
        similar = next(known[kind] for kind in _kinds(names[state.folder]) if kind in known)
        total += fmean(similar) * (1 - _share_done(state) if state.state == "running" else 1)
    return total / max(1, sum(state.state == "running" for state in states))


def _share_done(state: TrialState) -> float:
    try:
        iterations = TrialFolder(state.folder).configuration()["train"]["iterations"]
    except (InputError, KeyError, TypeError):
        return 0.0
    return min(1.0, _training(state.folder)[0] / max(1, iterations))


def _leader(experiment: Experiment, names: dict[Path, Name]) -> str:
    """The arm with the best mean over those scenes and seeds that all arms have, in words."""
    trials, questions = experiment.trials, experiment.history.questions
    metric = asked_quantity(questions[-1].metric if questions else "psnr", trials)
    values: dict[str, dict[tuple[str, int], float]] = {arm: {} for arm, _ in names.values()}
    for trial in trials:
        arm, scene = names[trial.path]
        if (value := metric.read(trial)) is not None:
            values[arm][scene, trial.seed] = value
    shared = set.intersection(*map(set, values.values())) if values else set()
    if len(values) < 2 or not shared or not metric.direction:
        return ""
    means = {arm: fmean(own[place] for place in shared) for arm, own in values.items()}
    return _in_words(means, metric, len(shared))


def _in_words(means: dict[str, float], metric: Quantity, shared: int) -> str:
    best = max(means, key=lambda arm: metric.direction * means[arm])
    if len({metric.format(mean) for mean in means.values()}) == 1:
        return f"no arm leads in {metric.name}; {shared} trials of each are compared"
    return (
        f"{best} leads so far: {metric.name} {metric.format(means[best])}, mean of the {shared} "
        "scenes and seeds that all arms have. This is not a verdict."
    )
