"""Tuning before or beside a comparison, as far as files tell: of what, with which budget, and what it chose."""

from __future__ import annotations

from collections.abc import Sequence

from gsbench.analysis.differences import differing_keys
from gsbench.analysis.results import Arm, TrialResult, by_key, read_experiment
from gsbench.records import read_if_sound
from gsbench.runs.experiments import Point, TuningRecord
from gsbench.runs.layout import TUNING
from gsbench.words import counted, listed

MOST_VALUES = 8  # points of a search that are named
NOTHING = "No tuning is recorded: each arm ran with one choice of settings. What was tried elsewhere is not known."
VIEWS = "validation views"  # on which every search judges its points
NO_BUDGET = "none"


def tuning_lines(trials: Sequence[TrialResult], pair: Sequence[Arm]) -> list[str]:
    """List, for each arm of a pair, the searches for its values, and which values were tried in these trials.

    Values that were tried in these trials were seen on the held-out views, which judge the verdict as well.
    """
    lines = [sentence] if (sentence := tuning_sentence(trials, pair)) else []
    for arm in pair:
        own = [trial for trial in trials if trial.arm == arm]
        searches = _searches(own[0])
        lines += [_search_line(own, name, record) for name, record in searches.items()]
        if not searches and any(record.sweep == _sweep(own[0]) for record in _records(own[0]).values()):
            lines.append(f"{_arm_in_records(own[0])}: not tuned, although its sweep tuned other arms.")
        lines += _tried_here(trials, own[0])
    return lines or [NOTHING]


def tuning_sentence(trials: Sequence[TrialResult], pair: Sequence[Arm]) -> str:
    """``They were not tuned alike: sfm-adc none, sfm-volumetric 6 points of 1 seed on validation views.``

    Empty where two arms had the same budget. What counts are searches whose best has the very values of an arm; several
    values that were all run as arms are no search, since each has its verdict.
    """
    budgets = [_budget(next(trial for trial in trials if trial.arm == arm)) for arm in pair]
    if len(set(budgets)) < 2:
        return ""
    said = listed([f"{arm} {budget}" for arm, budget in zip(pair, budgets, strict=True)])
    return f"They were not tuned alike: {said}."


def _budget(trial: TrialResult) -> str:
    """``6 points of 2 seeds on validation views``: of the largest search whose best the trial has; or ``none``."""
    found = [one for one in _searches(trial).values() if _has_values(trial, one.best)]
    if not found:
        return NO_BUDGET
    largest = max(found, key=lambda one: len(one.points) * len(one.seeds))
    return f"{counted(len(largest.points), 'point')} of {counted(len(largest.seeds), 'seed')} on {VIEWS}"


def _records(trial: TrialResult) -> dict[str, TuningRecord]:
    """All searches in a trial's runs folder, by their experiments."""
    files = sorted(trial.path.parents[3].glob(f"*/{TUNING}"))
    found = {file.parent.name: read_if_sound(file, TuningRecord) for file in files}
    return {name: record for name, record in found.items() if record is not None}


def _searches(trial: TrialResult) -> dict[str, TuningRecord]:
    """The searches of a trial's arm: by its own sweep, and others that proposed the trial's very values."""
    return {
        name: one
        for name, one in _records(trial).items()
        if one.arm == _arm_in_records(trial)
        and (one.sweep == _sweep(trial) or any(_has_values(trial, point) for point in one.points))
    }


def _sweep(trial: TrialResult) -> str:
    return trial.path.parents[2].name


def _arm_in_records(trial: TrialResult) -> str:
    """The name that records of searches have for the trial's arm, without its variant."""
    return f"{trial.init}-{trial.densify}"


def _search_line(own: Sequence[TrialResult], experiment: str, search: TuningRecord) -> str:
    """Say what a search tried of an arm and chose, and whether the arm's trials have that."""
    trial, best = own[0], search.best
    name = _arm_in_records(trial)
    if best is None:
        return f"{name}: the search {experiment} found nothing."
    chosen = listed([f"{key.lstrip('+~')}={value}" for key, value in sorted(best.settings.items())])
    line = (
        f"{name}: {chosen} is the best of {counted(len(search.points), 'point')} by {search.metric} of {VIEWS} "
        f"({listed(search.scenes)}; seed {', '.join(map(str, search.seeds))}; the search {experiment}), "
        f"{_when(own, experiment)}. Tried: {_points(search)}."
    )
    if not _has_values(trial, best):
        line += " These trials have other values."
    if len(search.points) > 1 and len({point.value for point in search.points}) == 1:
        line += " All points are equal to the last bit: the tuned setting had no effect."
    return line


def _when(own: Sequence[TrialResult], experiment: str) -> str:
    """Say whether the trials of the search were measured before these, by their files."""
    times = [trial.measured for trial in read_experiment(own[0].path.parents[3] / experiment).trials]
    if not times:
        return "whose own trials are missing"
    later = sum(trial.measured < max(times) for trial in own)
    return f"ended when {later} of these {len(own)} trials had been measured" if later else "before any of these trials"


def _points(search: TuningRecord) -> str:
    """``0.03 (27.31), 0.012 (failed)``"""
    shown = [
        f"{', '.join(map(str, point.settings.values()))} ({'failed' if point.value is None else f'{point.value:.4g}'})"
        for point in search.points[:MOST_VALUES]
    ]
    more = len(search.points) - MOST_VALUES
    return ", ".join(shown) + (f" and {more} more" if more > 0 else "")


def _tried_here(trials: Sequence[TrialResult], own: TrialResult) -> list[str]:
    """Name the settings in which arms of one class differ within an experiment: several values were tried."""
    target = own.config.get("densify._target_")
    kin = [t for t in trials if t.init == own.init and t.config and t.config.get("densify._target_") == target]
    choices = [group[0] for group in by_key(kin, lambda trial: trial.arm).values()]
    keys = sorted({key for other in choices for key in differing_keys(own.config, other.config)})
    if len(choices) < 2 or not keys:
        return []
    return [
        f"{own.arm}: {counted(len(choices), 'choice')} of its settings were run here. They differ in {listed(keys)}, "
        "and all were measured on the test views that the verdict uses."
    ]


def _has_values(trial: TrialResult, point: Point | None) -> bool:
    """Return whether a trial has the very values of a point."""
    if point is None or not point.settings:
        return False
    settings = {key.lstrip("+~"): value for key, value in point.settings.items()}
    return all(trial.config.get(key) == value for key, value in settings.items())
