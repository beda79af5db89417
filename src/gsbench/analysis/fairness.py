"""The fairness sheet of a comparison: all in which two arms differ, and what was tuned.

It is made from the trials' records, never written by hand, so nothing can be left out of
it that was recorded.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from typing import Any

from gsbench.analysis.configurations import canonical
from gsbench.analysis.differences import (
    CODE,
    differing_keys,
    ingredients_between,
    ingredients_sentence,
    representatives,
    short_version,
)
from gsbench.analysis.pairing import pair_trials
from gsbench.analysis.results import Arm, TrialResult
from gsbench.analysis.tables import Column, Entry, Row, Table
from gsbench.analysis.tuning import tuning_lines
from gsbench.words import counted

LONGEST = 60  # characters of a value that are shown
UNKNOWN, NONE = "not recorded", "–"
ALIKE, UNLIKE = "", "≠"
DIFFERS = "differs"  # heading of the column that marks what does

Reader = Callable[[TrialResult], float | None]


def fairness_table(trials: Sequence[TrialResult], first: Arm, second: Arm) -> Table:
    """The sheet of two arms of ``trials`` (all of the experiment, each with its variant) as a table with notes.

    What was measured is over the pairs of trials that are compared: a value, or the smallest and the largest of a
    trial. Raises ValueError for an arm without trials.
    """
    pairs = pair_trials(trials, first, second)
    one, other = pairs[0] if pairs else representatives(trials, first, second)
    compared = [trial for pair in pairs for trial in pair] or trials
    groups = [[trial for trial in compared if trial.arm == arm] for arm in (first, second)]
    rows = [_row(what, *(read(group) for group in groups)) for what, read in MEASURED.items()]
    settings = [_setting_row(key, one, other) for key in differing_keys(one.config, other.config)]
    if settings:
        settings[0] = Row(settings[0].labels, settings[0].entries, rule_above=True)
    notes = [ingredients_sentence(ingredients_between(trials, first, second), first, second)]
    notes += [f"Compared: {counted(len(pairs), 'pair')} of trials of one scene and seed."]
    notes += [f"Tuning. {line}" for line in tuning_lines(trials, (first, second))]
    return Table(
        f"Fairness sheet: {second} against {first}",
        ("what",),
        (Column("", str(first)), Column("", str(second)), Column("", DIFFERS)),
        (*rows, *settings),
        tuple(notes),
        (("", str(first)), ("", str(second)), ("", DIFFERS)),
        wrapped=True,
    )


def _row(what: str, first: str, second: str) -> Row:
    return Row((what,), (Entry(first), Entry(second), Entry(ALIKE if first == second else UNLIKE)))


def _setting_row(key: str, one: TrialResult, other: TrialResult) -> Row:
    return _row(key, *(_shown(trial.config[key]) if key in trial.config else NONE for trial in (one, other)))


def _shown(value: Any) -> str:
    text = value if isinstance(value, str) else canonical(value)
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 1]}…"


def _span(read: Reader, decimals: int = 0) -> Callable[[Sequence[TrialResult]], str]:
    """Shows a number of trials: one value, or the smallest and the largest with the mean."""

    def show(trials: Sequence[TrialResult]) -> str:
        values = [value for trial in trials if (value := read(trial)) is not None]
        if not values:
            return UNKNOWN
        low, high = (f"{value:,.{decimals}f}" for value in (min(values), max(values)))
        return low if low == high else f"{low} to {high}, mean {statistics.fmean(values):,.{decimals}f}"

    return show


def _each(read: Callable[[TrialResult], str | None]) -> Callable[[Sequence[TrialResult]], str]:
    """Shows the different texts of trials."""

    def show(trials: Sequence[TrialResult]) -> str:
        return ", ".join(sorted({read(trial) or UNKNOWN for trial in trials}))

    return show


def _rounds(trial: TrialResult) -> float | None:
    """Say how often the densifier refined; a log that is missing or empty says nothing."""
    return float(len(trial.folder.events())) or None


def _resolution(trial: TrialResult) -> str | None:
    size = trial.record.resolution
    return None if size is None else f"{size[0]}×{size[1]} px"


def budget_words(trial: TrialResult) -> str | None:
    """``15,000 Gaussians (governor), 600 s``; "none" without limits, None where nobody knows them."""
    budget = trial.record.budget
    if budget is None:
        return None
    count, seconds = budget.max_gaussians, budget.seconds
    parts = [f"{count:,} Gaussians ({budget.cap})" if count else "", f"{seconds:g} s" if seconds else ""]
    return ", ".join(filter(None, parts)) or "none"


def _code(trial: TrialResult) -> str | None:
    parts = [f"{part.removeprefix(CODE)} {short_version(version)}" for part, version in sorted(trial.code.items())]
    release = trial.record.versions.get("gsbench")
    program = f"{trial.program} {trial.trainer_version}".strip()
    return ", ".join(filter(None, [program, f"gsbench {release}" if release else "", *parts])) or None


# Settings that are shown of both arms, whether they differ in them or not.
MEASURED: dict[str, Callable[[Sequence[TrialResult]], str]] = {
    "trials": lambda trials: str(len(trials)),
    "views for training": _span(lambda trial: trial.record.train_views),
    "held-out views": _span(lambda trial: trial.record.test_views),
    "pictures": _each(_resolution),
    "photographs (hash)": _each(lambda trial: trial.record.hashes.get("data", "")[:12]),
    "initial points": _span(lambda trial: trial.record.num_init_points),
    "initial cloud (hash)": _each(lambda trial: trial.cloud[:12]),
    "iterations": _span(lambda trial: trial.record.iterations),
    "rounds of the densifier": _span(_rounds),
    "budget": _each(budget_words),
    "Gaussians in the end": _span(lambda trial: trial.record.num_gaussians),
    "seconds of training": _span(lambda trial: trial.record.seconds.get("train")),
    "memory (MB)": _span(lambda trial: trial.record.peak_memory_mb),
    "rasterizer": _each(lambda trial: trial.record.raster),
    "protocol": _each(lambda trial: trial.record.protocol),
    "machine": _each(lambda trial: trial.machine),
    "code": _each(_code),
}
