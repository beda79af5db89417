"""Tuning before or beside a comparison, as far as files tell: by which metric, on which views."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gsbench.analysis.attribution import TARGET, differing_keys
from gsbench.analysis.cells import by_key
from gsbench.analysis.results import Arm, TrialResult, canonical
from gsbench.analysis.shipped import shipped_name
from gsbench.parsing import DamagedError
from gsbench.runs.layout import SEARCH
from gsbench.runs.search_record import read_search
from gsbench.words import counted, listed

MOST_VALUES = 8  # of a setting, that are named
NOTHING = "No tuning is recorded: one choice of settings an arm was run here. What was tried elsewhere is not known."


def tuning_lines(trials: Sequence[TrialResult], pair: Sequence[Arm]) -> list[str]:
    """List, for each arm of a pair, the settings that were tried at several values in these trials, and in searches.

    Every such choice was seen on the held-out views, which judge the verdict as well, unless somebody kept it apart.
    """
    lines = []
    for arm in pair:
        own = [trial for trial in trials if trial.arm == arm]
        lines += _tried_here(trials, own[0]) + _searched(own[0])
    return lines or [NOTHING]


def _tried_here(trials: Sequence[TrialResult], own: TrialResult) -> list[str]:
    """The settings in which arms made from one differ within an experiment: values that were tried."""
    kin = [trial for trial in trials if trial.init == own.init and _kind(trial) == _kind(own)]
    choices = [group[0] for group in by_key(kin, lambda trial: trial.arm).values()]
    if len(choices) < 2 or not own.config:
        return []
    keys = sorted({key for other in choices for key in differing_keys(own.config, other.config)})
    values = [f"{key} ({_values([trial.config.get(key) for trial in choices])})" for key in keys]
    if not values:
        return []
    return [
        f"{'-'.join(own.arm)}: {counted(len(choices), 'choice')} of its settings were run here, which differ "
        f"in {listed(values)}, all measured on the held-out views that the verdict uses, too."
    ]


def _kind(trial: TrialResult) -> object:
    """The shipped arm that a trial's settings start from, else its class."""
    return shipped_name(trial.config) or trial.config.get(TARGET)


def _searched(own: TrialResult) -> list[str]:
    """Searches in the same runs folder that proposed the very values that the arm has."""
    runs = own.path.parents[3]
    return [line for file in sorted(runs.glob(f"*/{SEARCH}")) if (line := _search_line(file, own)) and own.config]


def _search_line(file: Path, own: TrialResult) -> str:
    try:
        search = read_search(file.parent)
    except (FileNotFoundError, DamagedError):
        return ""
    for point in search.points:
        settings = point.settings
        if settings and all(own.config.get(key) == settings[key] for key in settings):
            views = "validation views, none of which is held out" if search.validation else "its held-out views"
            chosen = listed([f"{key}={settings[key]}" for key in sorted(settings)])
            return (
                f"{'-'.join(own.arm)}: {chosen} is one of {counted(len(search.points), 'point')} of the search "
                f"{file.parent.name}, by {search.metric} of {views}."
            )
    return ""


def _values(values: Sequence[Any]) -> str:
    found = {canonical(value): value for value in values}
    numbers = sorted(
        (text for text in found if isinstance(found[text], int | float)), key=lambda text: float(found[text])
    )
    texts = [*numbers, *sorted(found.keys() - set(numbers))]
    more = len(texts) - MOST_VALUES
    return ", ".join(texts[:MOST_VALUES]) + (f" and {more} more" if more > 0 else "")
