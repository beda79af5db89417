"""Tables of an experiment in any layout: mean and deviation over trials, best in bold, what is missing marked."""

import itertools
from collections.abc import Iterable, Mapping, Sequence
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
from gsbench.analysis.notes import trials_notes
from gsbench.analysis.quantities import Quantity, choose_quantities
from gsbench.analysis.results import Experiment, TrialResult, by_key
from gsbench.analysis.table_formats import Column, Entry, Row, Table
from gsbench.words import counted, some_of

DEFAULT_ROWS = ("scene", "init", "densify")
SIDE_BY_SIDE = ("scene.split", "scene.sector")

Labels = tuple[str, ...]
Place = tuple[Labels, Labels, str]  # the labels of a row, those of an arm (a column), and the key of a quantity


def build_table(
    experiment: Experiment,
    trials: Sequence[TrialResult] | None = None,
    rows: Sequence[str] | None = None,
    columns: Sequence[str] = (),
    metrics: Sequence[str] | None = None,
    title: str | None = None,
    order: tuple[Sequence[Labels], Sequence[Labels]] | None = None,
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
    expected = 1 if "seed" in fields else len({trial.seed for trial in trials})
    row_keys, arm_keys = order or (
        sorted({key[: len(rows)] for key in groups}, key=_natural),
        sorted({key[len(rows) :] for key in groups}, key=_natural),
    )
    scenes = sorted({trial.scene for trial in trials})
    by_scene = fields.index("scene") if "scene" in fields else None
    cells: dict[Place, Cell] = {}
    for row, one, arm in itertools.product(row_keys, quantities, arm_keys):
        own = scenes if by_scene is None else [(*row, *arm)[by_scene]]
        cells[row, arm, one.key] = make_cell(groups.get((*row, *arm), []), one, own, expected)
    bold, notes = _best(cells, quantities, by_scene)
    shown = _rows(cells, bold, quantities)
    if "scene" in rows and len(scenes) > 1:
        means = _means(groups, list(rows).index("scene"), row_keys, arm_keys, quantities, scenes, expected)
        best = set() if notes else _best(means, quantities, None)[0]
        shown += _rows(means, best, quantities, ruled=True)
    heads = [
        Column(
            one.heading if columns else "",
            " + ".join(names.get(value, value) for value in arm) if columns else one.heading,
            (one.key, "+".join(arm)),
        )
        for one in quantities
        for arm in arm_keys
    ]
    notes += _reading_notes(cells, quantities, expected, by_scene is not None)
    notes += trials_notes(experiment, trials)
    if left_out := experiment.warnings:
        notes.append(f"Left out ({len(left_out)}): {some_of(left_out)}.")
    return Table(title or f"Experiment {experiment.name}", tuple(rows), tuple(heads), tuple(shown), tuple(notes))


def format_cell(cell: Cell, quantity: Quantity) -> str:
    """``27.10 ± 0.05``, with the trial count where it is not the expected one."""
    if cell.mean is None:
        return "n/a" if cell.trials else f"— ({cell.count}/{cell.expected})"
    text = quantity.format(cell.mean)
    if cell.std is not None:
        text += f" ± {quantity.format(cell.std)}"
    return text if cell.complete else f"{text} ({cell.count}/{cell.expected})"


def _rows(
    cells: Mapping[Place, Cell], bold: set[Place], quantities: Sequence[Quantity], ruled: bool = False
) -> list[Row]:
    """The cells row by row, the first perhaps below a rule; a mean of other scenes than its label says has a count."""
    formats = {one.key: one for one in quantities}
    usual = max((cell.scenes for cell in cells.values()), default=0)
    rows: list[Row] = []
    for labels, places in by_key(cells, lambda place: place[0]).items():
        entries = []
        for place in places:
            cell = cells[place]
            text = format_cell(cell, formats[place[2]]) if cell.scenes else "n/a"
            text += f" [{counted(cell.scenes, 'scene')}]" if 0 < cell.scenes != usual else ""
            entries.append(Entry(text, place in bold, cell))
        rows.append(Row(labels, tuple(entries), rule_above=ruled and not rows))
    return rows


def _best(
    cells: Mapping[Place, Cell], quantities: Sequence[Quantity], scene: int | None
) -> tuple[set[Place], list[str]]:
    """The best cells among those of one ``scene`` (its place in the labels), and a note for each scene whose cells
    cannot be compared.

    Cells whose views were held out otherwise answer another question, and are no rivals.
    """
    bold: set[Place] = set()
    notes: list[str] = []
    for quantity in quantities:
        own = {place: cell for place, cell in cells.items() if place[2] == quantity.key}
        rivals = by_key(
            own, lambda place: ("" if scene is None else (*place[0], *place[1])[scene], _split(cells[place]))
        )
        for (name, _), places in rivals.items():
            shown = [trial for place in places for trial in cells[place].trials]
            by_scene = by_key(shown, lambda trial: trial.scene)
            differing = {key for group in by_scene.values() for key in differing_conditions(group)}
            if differing:
                notes.append(f"{name or 'arms'}: not compared, no best marked: {', '.join(sorted(differing))} differ.")
            else:
                bold |= best_cells({place: cells[place] for place in places}, quantity)
    return bold, list(dict.fromkeys(notes))


def _split(cell: Cell) -> str:
    return cell.trials[0].split if cell.trials else ""


def _means(
    groups: Mapping[Labels, Sequence[TrialResult]],
    place: int,
    row_keys: Iterable[Labels],
    arm_keys: Sequence[Labels],
    quantities: Sequence[Quantity],
    scenes: Sequence[str],
    expected: int,
) -> dict[Place, Cell]:
    """The means over the scenes that every arm has; ``place`` is that of the scene among the labels. {} without any."""
    others = dict.fromkeys(key[:place] + key[place + 1 :] for key in row_keys)

    def trials(other: Labels, arm: Labels, scene: str) -> Sequence[TrialResult]:
        return groups.get((*other[:place], scene, *other[place:], *arm), [])

    def has_value(quantity: Quantity, scene: str) -> bool:
        """Return whether every arm has a value on the scene."""
        arms = itertools.product(others, arm_keys)
        return all(any(quantity.read(one) is not None for one in trials(*arm, scene)) for arm in arms)

    shared = {one.key: [scene for scene in scenes if has_value(one, scene)] for one in quantities}
    usual = max(map(len, shared.values()))
    if usual == 0:
        return {}
    label = f"mean of {counted(usual, 'scene')}"
    found: dict[Place, Cell] = {}
    for other, one, arm in itertools.product(others, quantities, arm_keys):
        own = [trial for scene in shared[one.key] for trial in trials(other, arm, scene)]
        row = (*other[:place], label, *other[place:])
        found[row, arm, one.key] = make_cell(own, one, shared[one.key], expected)
    return found


def _reading_notes(
    cells: Mapping[Place, Cell], quantities: Sequence[Quantity], expected: int, by_scene: bool
) -> list[str]:
    spread = "trials" if by_scene else "the trials' means of scenes"
    if expected == 1:
        notes = ["One trial per cell, so there is no deviation."]
    else:
        notes = [f"Mean over {expected} trials; ± is the deviation (n − 1) over {spread}."]
    notes.append("Bold: best mean of a scene after rounding; this is not a test.")
    if any(0 < cell.count < expected or not cell.trials for cell in cells.values()):
        notes.append(f"(k/{expected}): only k of {expected} trials have a value; —: none.")
    protocols = {trial.record.protocol for cell in cells.values() for trial in cell.trials}
    notes.append(f"Protocol {', '.join(sorted(protocols))}.")
    for one in quantities:
        reasons = {cell.reason for place, cell in cells.items() if place[2] == one.key and cell.trials and cell.reason}
        notes += [f"{one.name}: n/a, {reason}." for reason in sorted(reasons)]
    return notes


def _natural(key: Labels) -> tuple[tuple[int, float, str], ...]:
    """Sort numbers by value and other text by itself."""
    parts = []
    for text in key:
        try:
            parts.append((0, float(text), text))
        except ValueError:
            parts.append((1, 0.0, text))
    return tuple(parts)
