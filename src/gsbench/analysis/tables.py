"""Tables of an experiment: mean and deviation over trials, verdicts, missing values marked."""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType

from gsbench.analysis.cells import (
    Cell,
    check_averageable,
    check_fields,
    field_value,
    make_cell,
    swept_settings,
)
from gsbench.analysis.comparison import Comparison, compare, winners
from gsbench.analysis.differences import (
    between_scenes_notes,
    conditions_between_scenes,
    differing_code,
)
from gsbench.analysis.notes import Note
from gsbench.analysis.quantities import Quantity, choose_quantities
from gsbench.analysis.results import Arm, Experiment, TrialResult, group_by
from gsbench.analysis.table_formats import Column, Row, Table, TableEntry
from gsbench.analysis.table_notes import LEARNT_NOTHING, by_weight, trials_notes
from gsbench.analysis.trial_result import canonical
from gsbench.words import counted

DEFAULT_ROWS = ("scene", "init", "densify")
SIDE_BY_SIDE = ("scene.split", "scene.sector")
FIRST_NAMED = ("train.iterations", *SIDE_BY_SIDE)  # settings that stand for others

Labels = tuple[str, ...]
Position = tuple[Labels, Labels, Quantity]  # of a cell: the labels of its row and column


def build_table(
    experiment: Experiment,
    trials: Sequence[TrialResult] | None = None,
    rows: Sequence[str] | None = None,
    columns: Sequence[str] = (),
    metrics: Sequence[str] | None = None,
    title: str | None = None,
    order: tuple[Sequence[Labels], Sequence[Labels]] | None = None,
    names: Mapping[str, str] = MappingProxyType({}),
    comparison: Comparison | None = None,
) -> Table:
    """Cross the values of ``rows`` with those of ``columns``; each combination shows every metric.

    ``rows`` and ``columns`` are fields of a trial or dotted configuration keys. Cells average over
    all others: seeds as trials, scenes as means of scenes. By default, rows are scene, initialiser,
    densifier and every swept setting; swept splits are columns. ``order`` gives the rows and
    columns to show, even if nothing was run there. ``names`` replaces values in headings. Raises
    ``InputError`` if a cell would average unlike trials. ``comparison`` has the verdicts on the
    table's arms, by default those of the experiment. Bold is the best mean if it was shown to be
    better.
    """
    trials = list(experiment.trials if trials is None else trials)
    comparison = compare(experiment) if comparison is None else comparison
    folded: dict[str, list[str]] = {}
    if rows is None:
        folded = _changing_together(trials, swept_settings(trials))
        # another split is another question about the same arms, so it gets a column
        if not columns:
            columns = tuple(key for key in SIDE_BY_SIDE if key in folded)
        swept = [key for key in folded if key not in columns]
        rows = (*DEFAULT_ROWS, *swept)
    quantities = choose_quantities(trials, metrics)
    fields = (*rows, *columns)
    check_fields(trials, fields)
    groups = group_by(trials, lambda trial: tuple(field_value(trial, name) for name in fields))
    for key, group in groups.items():
        named = zip(fields, key, strict=True)
        check_averageable(group, " ".join(f"{name}={value}" for name, value in named))
    expected = 1 if "seed" in fields else len({trial.seed for trial in trials})
    row_labels, column_labels = order or (
        sorted({key[: len(rows)] for key in groups}, key=_natural),
        sorted({key[len(rows) :] for key in groups}, key=_natural),
    )
    scenes = sorted({trial.scene for trial in trials})
    scene_index = fields.index("scene") if "scene" in fields else None
    cells: dict[Position, Cell] = {}
    for row, quantity, column in itertools.product(row_labels, quantities, column_labels):
        own_scenes = scenes if scene_index is None else [(*row, *column)[scene_index]]
        cells[row, column, quantity] = make_cell(
            groups.get((*row, *column), []), quantity, own_scenes, expected
        )
    paths = {trial.path for trial in trials}
    varied = [trial for trial in comparison.trials if trial.path in paths]
    shown_best = winners(comparison)
    bold = _best(cells, shown_best, varied)
    shown, notes = _rows(cells, bold), list[Note]()
    has_means = "scene" in rows and len(scenes) > 1
    # scenes of an arm may have different conditions or versions of the code
    if has_means and any(
        conditions_between_scenes(of_arm) or differing_code(of_arm)
        for of_arm in group_by(varied, "arm").values()
    ):
        notes.append(Note.of("no mean"))
    elif has_means:
        means = _means(cells, list(rows).index("scene"), scenes, expected)
        best = _best(means, shown_best, varied)
        bold |= best
        shown += _rows(means, best, ruled=True)
    headings = []
    for quantity, column in itertools.product(quantities, column_labels):
        above, text = "", quantity.heading
        if columns:
            above, text = text, " + ".join(names.get(value, value) for value in column)
        headings.append(Column(above, text, (quantity.key, "+".join(column))))
    notes += _reading_notes(cells, expected, scene_index is not None, bool(bold))
    notes += [Note.of("folded", shown=key, others=own) for key, own in folded.items() if own]
    notes += between_scenes_notes(varied)
    notes += trials_notes(comparison, trials)
    # the line on versions stands for many trials, so it comes before the folders that are cut off
    if lines := [*experiment.versions, *experiment.faults]:
        notes.append(Note.of("unusable", count=experiment.left_out, folders=lines))
    heading = title or f"Experiment {experiment.name}"
    return Table(
        heading,
        tuple(rows),
        tuple(headings),
        tuple(shown),
        tuple(map(str, by_weight(notes))),
        verdicts=tuple(filter(None, [*(one.line for one in comparison.answers), comparison.risk])),
    )


def _changing_together(trials: Sequence[TrialResult], keys: Iterable[str]) -> dict[str, list[str]]:
    """For each setting that stands for those which change together with it, the others.

    A schedule has many steps, and its iterations name it best.
    """
    configs = {trial.key: trial.config for trial in trials}.values()

    def changes(key: str) -> tuple[int, ...]:
        first: dict[str, int] = {}
        return tuple(first.setdefault(canonical(own.get(key)), len(first)) for own in configs)

    ordered = sorted(keys, key=lambda key: (key not in FIRST_NAMED, key))
    return {own[0]: own[1:] for own in group_by(ordered, changes).values()}


def format_cell(cell: Cell, quantity: Quantity) -> str:
    """``27.10 ± 0.05``, with the number of trials if it is not the expected one."""
    if cell.mean is None:
        return "n/a" if cell.trials else f"— ({cell.count}/{cell.expected})"
    text = quantity.format(cell.mean)
    if cell.std is not None:
        text += f" ± {quantity.format(cell.std)}"
    if not quantity.cost and any(trial.record.learnt_nothing for trial in cell.trials):
        text += f" {LEARNT_NOTHING}"
    return text if cell.count == cell.expected else f"{text} ({cell.count}/{cell.expected})"


def _rows(cells: Mapping[Position, Cell], bold: set[Position], ruled: bool = False) -> list[Row]:
    """The cells row by row; if ``ruled``, the first row is below a rule.

    A cell over fewer scenes than the others says how many.
    """
    most_scenes = max((cell.scenes for cell in cells.values()), default=0)
    rows: list[Row] = []
    for labels, positions in group_by(cells, lambda position: position[0]).items():
        entries = []
        for position in positions:
            cell = cells[position]
            text = format_cell(cell, position[2]) if cell.scenes else "n/a"
            text += f" [{counted(cell.scenes, 'scene')}]" if 0 < cell.scenes != most_scenes else ""
            entries.append(TableEntry(text, position in bold, cell))
        # a setting that an arm does not have, or has unset
        shown = tuple("–" if label == str(None) else label for label in labels)
        rows.append(Row(shown, tuple(entries), rule_above=ruled and not rows))
    return rows


def _best(
    cells: Mapping[Position, Cell],
    winners: Mapping[tuple[str, frozenset[str]], set[Arm]],
    trials: Sequence[TrialResult],
) -> set[Position]:
    """The cells with the best mean whose arm was shown to be better, on exactly these scenes.

    ``winners`` are such arms by metric and scenes; ``trials`` have their variants.
    """
    arms = {trial.path: trial.arm for trial in trials}

    def rivals(place: Position) -> tuple[Quantity, frozenset[str]]:
        return place[2], frozenset(trial.scene for trial in cells[place].trials)

    bold: set[Position] = set()
    for (quantity, scenes), places in group_by(cells, rivals).items():
        merits = {
            place: quantity.direction * mean
            for place in places
            if (mean := cells[place].mean) is not None
        }
        for place, merit in merits.items():
            own = {arms[trial.path] for trial in cells[place].trials}
            if merit == max(merits.values()) and own <= winners.get((quantity.key, scenes), set()):
                bold.add(place)
    return bold


def _means(
    cells: Mapping[Position, Cell], place: int, scenes: Sequence[str], expected: int
) -> dict[Position, Cell]:
    """The means over the scenes on which every arm has a value; {} if there is no such scene.

    ``place`` is the index of the scene in the labels of a row.
    """

    def without_scene(position: Position) -> Position:
        row, column, quantity = position
        return (*row[:place], *row[place + 1 :]), column, quantity

    by_scene = {
        mean: {position[0][place]: cells[position] for position in own}
        for mean, own in group_by(cells, without_scene).items()
    }
    shared: dict[Quantity, Sequence[str]] = {}
    for (_, _, quantity), own in by_scene.items():
        with_value = {scene for scene, cell in own.items() if cell.mean is not None}
        shared[quantity] = [one for one in shared.get(quantity, scenes) if one in with_value]
    most_scenes = max(map(len, shared.values()))
    label = f"mean of {counted(most_scenes, 'scene')}"
    means: dict[Position, Cell] = {}
    for (row, column, quantity), own in by_scene.items():
        averaged = [trial for scene in shared[quantity] for trial in own[scene].trials]
        labels = (*row[:place], label, *row[place:])
        means[labels, column, quantity] = make_cell(averaged, quantity, shared[quantity], expected)
    return means if most_scenes else {}


def _reading_notes(
    cells: Mapping[Position, Cell],
    expected: int,
    by_scene: bool,
    has_bold: bool,
) -> list[Note]:
    """Notes on how to read the table's numbers and marks."""
    spread = "trials" if by_scene else "the trials' means of scenes"
    trials = list(itertools.chain(*(cell.trials for cell in cells.values())))
    facts = {
        "protocols": sorted({trial.record.protocol for trial in trials}),
        "bold": " Bold: the best mean, and shown to be better." if has_bold else "",
    }
    if expected == 1:
        notes = [Note.of("one trial", **facts)]
    else:
        notes = [Note.of("mean", trials=expected, spread=spread, **facts)]
    if any(0 < cell.count < expected or not cell.trials for cell in cells.values()):
        notes.append(Note.of("few values", trials=expected))
    for one, places in group_by(cells, lambda position: position[2]).items():
        reasons = {cells[place].reason for place in places if cells[place].trials} - {""}
        notes += [Note.of("not available", metric=one.name, reason=why) for why in sorted(reasons)]
    return notes


def _natural(key: Labels) -> tuple[tuple[int, float, str], ...]:
    """A sorting key: numbers by value, before other text in alphabetical order."""
    parts = []
    for text in key:
        try:
            parts.append((0, float(text), text))
        except ValueError:
            parts.append((1, 0.0, text))
    return tuple(parts)
