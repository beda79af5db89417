"""Tables of an experiment in any layout: mean and deviation over trials, best in bold, what is missing marked.

A table is plain data; ``gsbench.analysis.table_formats`` writes it as Markdown, CSV, LaTeX or HTML.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

from gsbench.analysis.cells import (
    Cell,
    best_cells,
    check_averageable,
    check_fields,
    field_value,
    make_cell,
    swept_settings,
)
from gsbench.analysis.differences import differing_conditions
from gsbench.analysis.notes import (
    cloud_notes,
    comparison_notes,
    held_out_notes,
    machine_notes,
    origin_notes,
    points_notes,
)
from gsbench.analysis.quantities import Quantity, choose_quantities
from gsbench.analysis.results import Experiment, TrialResult, by_key
from gsbench.words import counted

DEFAULT_ROWS = ("scene", "init", "densify")
SIDE_BY_SIDE = ("scene.split", "scene.sector")


@dataclass(frozen=True)
class Entry:
    """One cell as shown: ``text`` without markup, and the numbers behind it."""

    text: str
    bold: bool = False
    cell: Cell | None = None


@dataclass(frozen=True)
class Column:
    """A column's group (the quantity, shared by neighbours) and its own heading."""

    group: str
    heading: str


@dataclass(frozen=True)
class Row:
    labels: tuple[str, ...]
    entries: tuple[Entry, ...]
    rule_above: bool = False


@dataclass(frozen=True)
class Table:
    """A titled table with notes below it; ``keys`` names the quantity and the arm of each column for machines."""

    title: str
    row_headings: tuple[str, ...]
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()
    keys: tuple[tuple[str, str], ...] = field(default=(), repr=False)  # (quantity, arm) of each column
    wrapped: bool = False  # cells hold text that may need several lines on paper


def build_table(
    experiment: Experiment,
    trials: Sequence[TrialResult] | None = None,
    rows: Sequence[str] | None = None,
    columns: Sequence[str] = (),
    metrics: Sequence[str] | None = None,
    title: str | None = None,
    order: tuple[Sequence[tuple[str, ...]], Sequence[tuple[str, ...]]] | None = None,
    names: Mapping[str, str] = MappingProxyType({}),
) -> Table:
    """Cross the values of ``rows`` with those of ``columns``; each combination shows every metric.

    ``rows`` and ``columns`` are fields of a trial or dotted configuration keys; what stands in neither is averaged
    over: seeds as trials, scenes as means of scenes. By default, rows are scene, initialiser, densifier and every
    setting that was swept within those; splits that were swept stand side by side. ``order`` gives the rows and the
    columns to show, also where nothing was run; ``names`` replaces values in headings. Raises ``InputError`` where a
    cell would mix what may not be averaged.
    """
    trials = list(experiment.trials if trials is None else trials)
    if rows is None:
        swept = swept_settings(trials)
        if not columns:  # what is held out asks another question, not of another arm: side by side
            columns = tuple(key for key in SIDE_BY_SIDE if key in swept)
        rows = (*DEFAULT_ROWS, *(key for key in swept if key not in columns))
    quantities = choose_quantities(trials, metrics)
    fields = (*rows, *columns)
    check_fields(trials, fields)
    groups = by_key(trials, lambda trial: tuple(field_value(trial, name) for name in fields))
    for key, group in groups.items():
        check_averageable(group, " ".join(f"{name}={value}" for name, value in zip(fields, key, strict=True)))
    expected = len({trial.seed for trial in trials}) if "seed" not in fields else 1
    row_keys = sorted({key[: len(rows)] for key in groups}, key=_natural)
    arm_keys = sorted({key[len(rows) :] for key in groups}, key=_natural)
    if order is not None:
        row_keys, arm_keys = list(order[0]), list(order[1])
    scenes = sorted({trial.scene for trial in trials})

    def cell(key: tuple[str, ...], quantity: Quantity) -> Cell:
        own = [key[fields.index("scene")]] if "scene" in fields else scenes
        return make_cell(groups.get(key, []), quantity, own, expected)

    grid = {
        (row + arm, quantity.key): cell(row + arm, quantity)
        for row, arm, quantity in itertools.product(row_keys, arm_keys, quantities)
    }
    bold, notes = _best(grid, fields, quantities)
    shown = [
        Row(
            row,
            tuple(
                _entry(grid[row + arm, q.key], q, (row + arm, q.key) in bold) for q in quantities for arm in arm_keys
            ),
        )
        for row in row_keys
    ]
    if "scene" in rows and len(scenes) > 1:
        shown += _mean_rows(groups, rows, row_keys, arm_keys, quantities, scenes, expected, comparable=not notes)
    arms = [" + ".join(names.get(value, value) for value in arm) for arm in arm_keys]
    keys = tuple((quantity.key, "+".join(arm)) for quantity in quantities for arm in arm_keys)
    heads = tuple(Column(q.heading, arm) if columns else Column("", q.heading) for q in quantities for arm in arms)
    notes += _reading_notes(grid, quantities, expected, "scene" in fields) + origin_notes(trials)
    notes += (
        comparison_notes(experiment)
        + held_out_notes(trials)
        + points_notes(trials)
        + machine_notes(trials)
        + cloud_notes(trials)
        + _left_out(experiment)
    )
    return Table(title or f"Experiment {experiment.name}", tuple(rows), heads, tuple(shown), tuple(notes), keys)


def format_cell(cell: Cell, quantity: Quantity) -> str:
    """``27.10 ± 0.05``, with the trial count where it is not the expected one."""
    if cell.mean is None:
        return "n/a" if cell.trials else f"— ({cell.count}/{cell.expected})"
    text = quantity.format(cell.mean)
    if cell.std is not None:
        text += f" ± {quantity.format(cell.std)}"
    return text if cell.complete else f"{text} ({cell.count}/{cell.expected})"


def _entry(cell: Cell, quantity: Quantity, bold: bool) -> Entry:
    return Entry(format_cell(cell, quantity), bold, cell)


def _best(
    grid: dict[tuple[tuple[str, ...], str], Cell], fields: Sequence[str], quantities: Sequence[Quantity]
) -> tuple[set[object], list[str]]:
    """The best cells among those of one scene, and a note for each scene whose cells cannot be compared."""
    place = fields.index("scene") if "scene" in fields else None
    bold: set[object] = set()
    notes: dict[str, None] = {}
    for quantity in quantities:
        rivals: dict[tuple[str, str], dict[object, Cell]] = {}
        for (key, name), cell in grid.items():
            if name == quantity.key:
                rivals.setdefault(("" if place is None else key[place], _split(cell)), {})[key, name] = cell
        for (scene, _), cells in rivals.items():
            by_scene = by_key([trial for cell in cells.values() for trial in cell.trials], lambda trial: trial.scene)
            differing = {key for group in by_scene.values() for key in differing_conditions(group)}
            if differing:
                notes[f"{scene or 'arms'}: not compared, no best marked: {', '.join(sorted(differing))} differ."] = None
            else:
                bold |= best_cells(cells, quantity)
    return bold, list(notes)


def _split(cell: Cell) -> str:
    """Views held out for a cell, in words; cells of different splits answer different questions, and are no rivals."""
    return cell.trials[0].split if cell.trials else ""


def _mean_rows(
    groups: dict[tuple[str, ...], list[TrialResult]],
    rows: Sequence[str],
    row_keys: Sequence[tuple[str, ...]],
    arm_keys: Sequence[tuple[str, ...]],
    quantities: Sequence[Quantity],
    scenes: Sequence[str],
    expected: int,
    comparable: bool,
) -> list[Row]:
    """Means over the scenes that every arm has, one row for each combination of the other row fields; none without."""
    place = list(rows).index("scene")
    others = list(dict.fromkeys(key[:place] + key[place + 1 :] for key in row_keys))

    def full(other: tuple[str, ...], arm: tuple[str, ...], scene: str) -> tuple[str, ...]:
        return (*other[:place], scene, *other[place:], *arm)

    cells: dict[tuple[tuple[str, ...], tuple[str, ...], str], Cell] = {}
    counts = {}
    for quantity in quantities:
        arms = list(itertools.product(others, arm_keys))
        shared = [
            scene
            for scene in scenes
            if all(any(quantity.read(t) is not None for t in groups.get(full(o, a, scene), [])) for o, a in arms)
        ]
        counts[quantity.key] = len(shared)
        for other, arm in arms:
            trials = [trial for scene in shared for trial in groups[full(other, arm, scene)]]
            cells[other, arm, quantity.key] = make_cell(trials, quantity, shared, expected)
    # Scenes missing for one quantity only would make one label wrong: such a quantity says its own count.
    usual = max(counts.values())
    if usual == 0:
        return []
    bold: set[object] = set()
    for quantity in quantities if comparable else ():
        own = {key: cell for key, cell in cells.items() if key[2] == quantity.key}
        for split in {_split(cell) for cell in own.values()}:
            bold |= best_cells({key: cell for key, cell in own.items() if _split(cell) == split}, quantity)
    label = f"mean of {counted(usual, 'scene')}"
    result = []
    for index, other in enumerate(others):
        entries = []
        for quantity, arm in itertools.product(quantities, arm_keys):
            cell, count = cells[other, arm, quantity.key], counts[quantity.key]
            text = format_cell(cell, quantity) if count else "n/a"
            text += f" [{counted(count, 'scene')}]" if 0 < count != usual else ""
            entries.append(Entry(text, (other, arm, quantity.key) in bold, cell))
        result.append(Row((*other[:place], label, *other[place:]), tuple(entries), rule_above=index == 0))
    return result


def _reading_notes(
    grid: dict[tuple[tuple[str, ...], str], Cell], quantities: Sequence[Quantity], expected: int, by_scene: bool
) -> list[str]:
    spread = "trials" if by_scene else "the trials' means of scenes"
    if expected == 1:
        notes = ["One trial per cell, so there is no deviation."]
    else:
        notes = [f"Mean over {expected} trials; ± is the deviation (n − 1) over {spread}."]
    notes.append("Bold: best mean of a scene after rounding; this is not a test.")
    cells = grid.values()
    if any(0 < cell.count < expected or not cell.trials for cell in cells):
        notes.append(f"(k/{expected}): only k of {expected} trials have a value; —: none.")
    protocols = {trial.record.protocol for cell in cells for trial in cell.trials}
    notes.append(f"Protocol {', '.join(sorted(protocols))}.")
    for quantity in quantities:
        reasons = {
            cell.reason for (_, key), cell in grid.items() if key == quantity.key and cell.trials and cell.reason
        }
        notes += [f"{quantity.name}: n/a, {reason}." for reason in sorted(reasons)]
    return notes


def _left_out(experiment: Experiment) -> list[str]:
    if not experiment.warnings:
        return []
    shown, more = experiment.warnings[:3], len(experiment.warnings) - 3
    rest = f"; and {more} more" if more > 0 else ""
    return [f"Left out ({len(experiment.warnings)}): {'; '.join(shown)}{rest}."]


def _natural(key: tuple[str, ...]) -> tuple[tuple[int, float, str], ...]:
    """Sort numbers by value and other text by itself."""
    parts = []
    for text in key:
        try:
            parts.append((0, float(text), text))
        except ValueError:
            parts.append((1, 0.0, text))
    return tuple(parts)
