"""The fairness of a comparison: everything in which two arms differ, and how each was tuned.

The sheet and the sentences are made from the trials' records, so they leave out nothing that was
recorded.
"""

import itertools
import math
import statistics
from collections.abc import Callable, Iterable, Sequence
from operator import attrgetter
from typing import Any

from gsbench.analysis.differences import (
    as_text,
    between_scenes_notes,
    compared_trials,
    differing_keys,
    ingredients_between,
    ingredients_note,
    is_mixed,
)
from gsbench.analysis.notes import Note
from gsbench.analysis.pairs import pair_trials
from gsbench.analysis.quantities import COSTS, relative_change
from gsbench.analysis.results import Arm, TrialResult, group_by, trials_of
from gsbench.analysis.table_formats import Table, text_table
from gsbench.parsing import read_if_sound
from gsbench.runs.experiments import SearchPoint, TuningRecord
from gsbench.runs.layout import EVENTS, TUNING
from gsbench.words import counted, value_words

CAP, LIMIT = "densify.cap", "densify.max_gaussians"
DIGITS = 3  # significant digits of a number of Gaussians
LONGEST = 60  # the most characters of a value that are shown
UNKNOWN, NONE = "not recorded", "–"
UNLIKE = "≠"
# relative difference up to which counts are equal; densify.cap=governor holds counts closer
EQUAL_COUNTS = 0.02
MAX_VALUES = 8  # the most points of a search that are shown


def caveats(trials: Sequence[TrialResult], first: Arm, second: Arm) -> list[Note]:
    """Notes on several differing ingredients and on unequal tuning."""
    names = ingredients_between(trials, first, second)
    mixed = ingredients_note(names, first, second) if is_mixed(names) else None
    return [note for note in (mixed, tuning_note(trials, (first, second))) if note]


def counts_notes(trials: Sequence[TrialResult], pairs: Iterable[tuple[Arm, Arm]]) -> list[Note]:
    """A note for each baseline on the arms that have more Gaussians over common scenes, or fewer.

    It says how to compare all of these at equal counts.
    """
    by_arm, notes = group_by(trials, "arm"), []
    for first, own in group_by(pairs, lambda pair: pair[0]).items():
        baseline, unequal = by_arm.get(first, []), dict[Arm, float]()
        for _, second in own:
            change = relative_change(baseline, by_arm.get(second, []), COSTS["gaussians"][1])
            if change is not None and abs(change.of_totals) > EQUAL_COUNTS:
                unequal[second] = change.of_totals
        if not unequal:
            continue
        others = [trial for arm in unequal for trial in by_arm[arm]]
        arms = [
            f"{arm} {100 * abs(more):.0f} % {'more' if more > 0 else 'fewer'}"
            for arm, more in unequal.items()
        ]
        advice = equal_counts_advice([*baseline, *others])
        notes.append(Note.of("unequal counts", arms=arms, baseline=first, advice=advice))
    return notes


def equal_counts_advice(trials: Sequence[TrialResult]) -> str:
    """The advice that gives arms equal numbers of Gaussians; "" if counts are unknown."""
    records = [trial.record for trial in trials]
    points = max(record.num_init_points or 0 for record in records)
    counts = [record.num_gaussians for record in records if record.num_gaussians]
    if not counts:
        return ""
    if min(counts) <= points:
        return f"start all arms with fewer than {points:,} points, as no limit can be below these"
    aims = {(trial.config.get(CAP), trial.config.get(LIMIT)) for trial in trials}
    if len(aims) == 1 and next(iter(aims))[0] == "governor":
        return (
            "train longer, since the governor (densify.cap) had too few rounds to reach its count"
        )
    unit = 10 ** max(0, math.floor(math.log10(min(counts))) + 1 - DIGITS)
    words = f"{CAP}=governor {LIMIT}={min(counts) // unit * unit}"
    return f"give all arms {words} and another name"


def fairness_table(trials: Sequence[TrialResult], first: Arm, second: Arm) -> Table:
    """The fairness sheet of two arms as a table with notes.

    ``trials`` are all trials of the experiment that count, each with its variant. Measured rows
    cover the paired trials: one value, or the smallest, the largest and the mean. Raises KeyError
    for an arm without trials.
    """
    pairs = pair_trials(trials, first, second)
    compared = list(itertools.chain(*pairs)) or trials
    groups = [trials_of(compared, arm) for arm in (first, second)]
    shown = {"trials": [str(len(own)) for own in groups]}
    shown |= {what: [_shown_over(own, read) for own in groups] for what, read in MEASURED.items()}
    configs = [
        (one.config, other.config) for one, other in compared_trials(compared, first, second)
    ]
    for key in itertools.chain(*(differing_keys(*both) for both in configs)):
        # several values if they differ between scenes
        sides = (
            dict.fromkeys(_shown(own[key]) if key in own else NONE for own in side)
            for side in zip(*configs, strict=True)
        )
        shown[key] = list(map(", ".join, sides))
    rows = {
        what: (one, other, UNLIKE if one != other else "") for what, (one, other) in shown.items()
    }
    notes = [ingredients_note(ingredients_between(trials, first, second), first, second)]
    notes += between_scenes_notes(*groups)
    notes += [Note.of("compared", pairs=len(pairs))]
    tuning = [f"Tuning. {note}" for note in tuning_notes(trials, (first, second))]
    return text_table(
        f"Fairness sheet: {second} against {first}",
        "what",
        (first, second, "differs"),
        rows,
        ruled=len(MEASURED) + 1,
        notes=(*map(str, notes), *tuning),
        wrapped=True,
    )


def _shown(value: Any) -> str:
    text = value_words(as_text(value))
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 1]}…"


def _shown_over(trials: Sequence[TrialResult], read: Callable[[TrialResult], Any]) -> str:
    """A fact of trials: one value; of several numbers the smallest, the largest and the mean."""
    values = [read(trial) for trial in trials]
    numbers = [value for value in values if isinstance(value, int | float)]
    if not numbers:
        return ", ".join(sorted({value or UNKNOWN for value in values}))
    low, high = f"{min(numbers):,.0f}", f"{max(numbers):,.0f}"
    return low if low == high else f"{low} to {high}, mean {statistics.fmean(numbers):,.0f}"


def budget_words(trial: TrialResult) -> str | None:
    """``15,000 Gaussians (governor), 600 s``; "none" without limits, None if unrecorded."""
    budget = trial.record.budget
    if budget is None:
        return None
    count, seconds = budget.max_gaussians, budget.seconds
    parts = [f"{count:,} Gaussians ({budget.cap})"] if count else []
    parts += [f"{seconds:g} s"] if seconds else []
    return ", ".join(parts) or "none"


def _of_cloud(trial: TrialResult, fact: str, form: str) -> str | None:
    """A fact of the trial's initial points, formatted; None if it was not measured."""
    value = getattr(trial.record.initial_cloud, fact, None)
    return None if value is None else format(value, form)


def _code(trial: TrialResult) -> str:
    release = trial.record.versions.get("gsbench")
    program = f"{trial.program} {trial.trainer_version}".strip()
    parts = [program, f"gsbench {release}" if release else "", *trial.code_texts]
    return ", ".join(filter(None, parts))


# Rows that every sheet has: a fact of a trial, as a number or as text.
MEASURED: dict[str, Callable[[TrialResult], Any]] = {
    "views for training": attrgetter("record.train_views"),
    "held-out views": attrgetter("record.test_views"),
    "pictures": (
        lambda trial: trial.record.resolution and "{}×{} px".format(*trial.record.resolution)
    ),
    "photographs (hash)": lambda trial: trial.record.hashes.get("data", "")[:12],
    "test views with a near twin in training": (
        lambda trial: None if trial.record.twins is None else len(trial.record.twins.near)
    ),
    "initial points": attrgetter("record.num_init_points"),
    "initial points in two training views": lambda trial: _of_cloud(trial, "seen", ".1%"),
    "agreement of their colours with photographs": (
        lambda trial: _of_cloud(trial, "color_agreement", ".2f")
    ),
    "initial cloud (hash)": lambda trial: trial.cloud[:12],
    "iterations": attrgetter("record.iterations"),
    "rounds of the densifier": lambda trial: len(trial.folder.curves(EVENTS)) or None,
    "budget": budget_words,
    "Gaussians in the end": attrgetter("record.num_gaussians"),
    "seconds of training": lambda trial: trial.record.seconds.get("train"),
    "memory (MB)": attrgetter("record.peak_memory_mb"),
    "rasterizer": attrgetter("record.raster"),
    "protocol": attrgetter("record.protocol"),
    "machine": attrgetter("machine"),
    "code": _code,
}


def tuning_notes(trials: Sequence[TrialResult], pair: Sequence[Arm]) -> list[Note]:
    """List, for each arm of a pair, its searches, and whether the arms were tuned alike."""
    unlike = tuning_note(trials, pair)
    notes = [unlike] if unlike else []
    for arm in pair:
        own = trials_of(trials, arm)
        notes += [_search_note(own, name, record) for name, record in searches_of(own[0]).items()]
    return notes or [Note.of("no tuning")]


def tuning_note(trials: Sequence[TrialResult], pair: Sequence[Arm]) -> Note | None:
    """Say that a pair's arms were not tuned alike; None if both had the same tuning budget.

    A search counts if its best point has exactly the arm's settings. Settings that were all run as
    arms are no search, since each has its own verdict.
    """
    budgets = []
    for arm in pair:
        trial = trials_of(trials, arm)[0]
        sizes = [
            (len(search.points), len(search.seeds))
            for search in searches_of(trial).values()
            if _has_settings(trial, search.best)
        ]
        points, seeds = max(sizes, key=math.prod, default=(0, 0))
        tried = f"{counted(points, 'point')} of {counted(seeds, 'seed')} on validation views"
        budgets.append(tried if points else "none")
    if budgets[0] == budgets[1]:
        return None
    return Note.of(
        "unlike tuning", arms=[f"{arm} {own}" for arm, own in zip(pair, budgets, strict=True)]
    )


def searches_of(trial: TrialResult) -> dict[str, TuningRecord]:
    """The searches of a trial's arm in its runs folder, by experiment.

    These are the searches for the trial's own sweep, and those that tried exactly its settings.
    """
    arm, sweep = f"{trial.init}-{trial.densify}", trial.path.parents[2].name
    searches = {}
    # Each search has an experiment of its own, and may be from before this sweep.
    for file in sorted(trial.path.parents[3].glob(f"*/{TUNING}")):
        search = read_if_sound(file, TuningRecord)
        if search is None or search.arm != arm:
            continue
        if search.sweep == sweep or any(_has_settings(trial, point) for point in search.points):
            searches[file.parent.name] = search
    return searches


def _search_note(own: Sequence[TrialResult], experiment: str, search: TuningRecord) -> Note:
    """Say what a search tried and chose, and whether its arm's trials ``own`` have that."""
    best = search.best
    if best is None:
        return Note.of("vain search", arm=search.arm, experiment=experiment)
    chosen = [f"{key.lstrip('+~')}={value}" for key, value in sorted(best.settings.items())]
    tried = [
        f"{', '.join(map(str, point.settings.values()))} "
        f"({'failed' if point.value is None else f'{point.value:.4g}'})"
        for point in search.points[:MAX_VALUES]
    ]
    return Note.of(
        "search",
        arm=search.arm,
        chosen=chosen,
        points=len(search.points),
        metric=search.metric,
        scenes=search.scenes,
        seeds=search.seeds,
        experiment=experiment,
        tried=tried,
        more=max(0, len(search.points) - MAX_VALUES),
        others="" if _has_settings(own[0], best) else " These trials have other values.",
    )


def _has_settings(trial: TrialResult, point: SearchPoint | None) -> bool:
    """Return whether a trial has exactly the settings of a search point."""
    if point is None or not point.settings:
        return False
    # without Hydra's override prefixes
    settings = {key.lstrip("+~"): value for key, value in point.settings.items()}
    return all(trial.config.get(key) == value for key, value in settings.items())
