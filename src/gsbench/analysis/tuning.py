"""Tuning before or beside a comparison, as far as files tell: of what, with which budget, on which views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from gsbench.analysis.attribution import TARGET, differing_keys
from gsbench.analysis.configurations import canonical, resolved, shipped_arms, shipped_name
from gsbench.analysis.results import Arm, TrialResult, by_key, read_experiment
from gsbench.records import read_if_sound
from gsbench.runs.layout import TUNING
from gsbench.runs.tuning_record import Point, TuningRecord, is_value
from gsbench.words import counted, listed

MOST_VALUES = 8  # of a setting, or points of a search, that are named
NOTHING = "No tuning is recorded: one choice of settings an arm was run here. What was tried elsewhere is not known."
VIEWS = "validation views"  # on which every search judges its points


@dataclass(frozen=True)
class Budget:
    """The search for an arm's values: ``points``, each of as many ``trials`` of a scene."""

    points: int = 0
    trials: int = 0

    def __str__(self) -> str:
        """``6 points of 2 seeds on validation views``, or ``none``."""
        return f"{counted(self.points, 'point')} of {counted(self.trials, 'seed')} on {VIEWS}" if self else "none"

    def __bool__(self) -> bool:
        return self.points > 0


def tuning_lines(trials: Sequence[TrialResult], pair: Sequence[Arm]) -> list[str]:
    """List, for each arm of a pair, how its sweep tuned it, which values were tried in these trials, and in searches.

    Values that were tried in these trials were seen on the held-out views, which judge the verdict as well.
    """
    lines = [sentence] if (sentence := tuning_sentence(trials, pair)) else []
    for arm in pair:
        own = [trial for trial in trials if trial.arm == arm]
        lines += _tuned_here(own) + _tried_here(trials, own[0]) + _searched(own[0])
    return lines or [NOTHING]


def tuning_sentence(trials: Sequence[TrialResult], pair: Sequence[Arm]) -> str:
    """``Their tuning was unequal: sfm-adc none, sfm-volumetric 6 points of 1 seed on validation views.``

    Empty where two arms had the same budget. What counts are searches whose best has the very values of an arm; several
    values that were all run as arms are no search, since each has its verdict.
    """
    budgets = [_budget(next(trial for trial in trials if trial.arm == arm)) for arm in pair]
    if len(set(budgets)) < 2:
        return ""
    said = listed([f"{arm} {budget}" for arm, budget in zip(pair, budgets, strict=True)])
    return f"Their tuning was unequal: {said}."


def _budget(trial: TrialResult) -> Budget:
    """Of the tuning by the trial's own sweep, else of the searches whose best it has: the largest."""
    if tuned := _tunings_of_sweep(trial):
        found = [one for one in tuned.values() if one.arm == _arm_in_records(trial) and _is_of(trial, one.best)]
    else:
        found = [one for _, one in _searches(trial) if _is_of(trial, one.best) and not _is_shipped(trial, one.best)]
    budgets = [Budget(len(search.points), len(search.seeds)) for search in found]
    return max(budgets, key=lambda budget: budget.points * budget.trials, default=Budget())


def _tunings_of_sweep(trial: TrialResult) -> dict[str, TuningRecord]:
    """The searches by which the trial's own sweep tuned its arms, by their experiments."""
    return {name: record for name, record in _records(trial) if record.sweep == trial.path.parents[2].name}


def _arm_in_records(trial: TrialResult) -> str:
    """The name that records of tunings and searches have for the trial's arm, without its variant."""
    return f"{trial.init}-{trial.densify}"


def _tuned_here(own: Sequence[TrialResult]) -> list[str]:
    """Say what the sweep's tuning tried of an arm and chose, and whether these trials have it."""
    trial = own[0]
    tunings, name = _tunings_of_sweep(trial), _arm_in_records(trial)
    if not tunings:
        return []
    experiment, search = next(((key, one) for key, one in tunings.items() if one.arm == name), ("", None))
    best = None if search is None else search.best
    if search is None or best is None:
        return [f"{name}: left as it is by the tuning of its sweep."]
    chosen, where = listed(_settings(best)), listed(search.scenes)
    if not _is_of(trial, best):
        return [f"{name}: tuned to {chosen} by its sweep, but these trials have other values."]
    failed = sum(point.value is None for point in search.points)
    points = counted(len(search.points), "point") + (f" ({failed} failed)" if failed else "")
    seeds = ", ".join(map(str, search.seeds))
    line = (
        f"{name}: {chosen} is the best of {points} by {search.metric} of {VIEWS} ({where}; seed {seeds}), "
        f"{_when(own, experiment)}. "
        f"Searched: {listed([f'{key}={text}' for key, text in search.ranges.items()])}; "
        f"{'the first point was the arm as it is' if search.as_it_is else 'the arm as it is was no point'}. "
        f"Tried: {_points(search)}."
    )
    values = {point.value for point in search.points if point.value is not None}
    if len(values) == 1 and len(search.points) > 1:
        line += " All points are equal to the last bit: what was tuned never acted."
    return [line]


def _when(own: Sequence[TrialResult], experiment: str) -> str:
    """Say whether the trials of the tuning's ``experiment`` were measured before these, by their files."""
    times = [trial.measured for trial in read_experiment(own[0].path.parents[3] / experiment).trials]
    if not times:
        return "whose own trials are not there"
    later = sum(trial.measured < max(times) for trial in own)
    return f"ended when {later} of these {len(own)} trials had been measured" if later else "before any of these trials"


def _points(search: TuningRecord) -> str:
    """``0.03 (27.31), 0.012 (27.4)``"""
    shown = [
        f"{', '.join(map(str, point.settings.values()))} ({'failed' if point.value is None else f'{point.value:.4g}'})"
        for point in search.points[:MOST_VALUES]
    ]
    more = len(search.points) - MOST_VALUES
    return ", ".join(shown) + (f" and {more} more" if more > 0 else "")


def _tried_here(trials: Sequence[TrialResult], own: TrialResult) -> list[str]:
    """The settings in which arms made from one differ within an experiment: values that were tried."""
    configurations = [group[0] for group in by_key(trials, lambda trial: trial.key).values()]
    kin = [trial for trial in configurations if trial.init == own.init and _kind(trial) == _kind(own)]
    choices = [group[0] for group in by_key(kin, lambda trial: trial.arm).values()]
    if len(choices) < 2 or not own.config:
        return []
    keys = sorted({key for other in choices for key in differing_keys(own.config, other.config)})
    values = [f"{key} ({_values([trial.config.get(key) for trial in choices])})" for key in keys]
    if not values:
        return []
    return [
        f"{own.arm}: {counted(len(choices), 'choice')} of its settings were run here, which differ "
        f"in {listed(values)}, all measured on the held-out views that the verdict uses, too."
    ]


def _kind(trial: TrialResult) -> object:
    """The shipped arm that a trial's settings start from, else its class."""
    return shipped_name(trial.config) or trial.config.get(TARGET)


def _searched(own: TrialResult) -> list[str]:
    """Searches of other sweeps in the same runs folder that proposed the very values that the arm has."""
    lines = []
    for name, search in _searches(own):
        point = next((point for point in search.points if _is_of(own, point)), None)
        if point is None or name in _tunings_of_sweep(own):
            continue
        place = "the best" if point == search.best else "one"
        lines.append(
            f"{own.arm}: {listed(_settings(point))} is {place} of {counted(len(search.points), 'point')} of "
            f"the search {name}, by {search.metric} of {VIEWS}, none of which is held out."
        )
    return lines


def _searches(own: TrialResult) -> list[tuple[str, TuningRecord]]:
    """The searches of a trial's arm in its runs folder, with the names of their experiments."""
    return [(name, record) for name, record in _records(own) if record.arm == _arm_in_records(own)]


def _records(own: TrialResult) -> list[tuple[str, TuningRecord]]:
    """All searches in a trial's runs folder, with the names of their experiments."""
    files = sorted(own.path.parents[3].glob(f"*/{TUNING}"))
    found = [(file.parent.name, read_if_sound(file, TuningRecord)) for file in files]
    return [(name, record) for name, record in found if record is not None]


def _is_of(trial: TrialResult, point: Point | None) -> bool:
    """Return whether a trial has the very values of a point."""
    if point is None or not point.settings:
        return False
    config, settings = trial.config, {key.lstrip("+~"): value for key, value in point.settings.items()}
    return all(key in config and is_value(config[key], value) for key, value in settings.items())


def _is_shipped(trial: TrialResult, point: Point | None) -> bool:
    """Return whether a point of a search elsewhere has the values of the arm's own file, which need no search."""
    name = shipped_name(trial.config)
    if name is None or point is None:
        return False
    own = resolved(shipped_arms()[name], trial.config)
    return all(key in own and is_value(own[key], value) for key, value in point.settings.items())


def _settings(point: Point) -> list[str]:
    return [f"{key.lstrip('+~')}={point.settings[key]}" for key in sorted(point.settings)]


def _values(values: Sequence[Any]) -> str:
    found = {canonical(value): value for value in values}
    numbers = sorted(
        (text for text in found if isinstance(found[text], int | float)), key=lambda text: float(found[text])
    )
    texts = [*numbers, *sorted(found.keys() - set(numbers))]
    more = len(texts) - MOST_VALUES
    return ", ".join(texts[:MOST_VALUES]) + (f" and {more} more" if more > 0 else "")
