"""Printed numbers of papers, their tables as measured, and the differences."""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import yaml

from gsbench.analysis.cells import Cell, check_averageable, make_cell
from gsbench.analysis.comparison import Comparison
from gsbench.analysis.quantities import choose_quantities, quantity
from gsbench.analysis.results import Arm, Experiment, TrialResult, group_by
from gsbench.analysis.statistics import StudentT
from gsbench.analysis.table_formats import Column, Row, Table, TableEntry
from gsbench.analysis.tables import build_table
from gsbench.errors import InputError
from gsbench.words import did_you_mean, signed

# suffix of an experiment that repeats a table with each initialiser's own poses and gauge
OWN = "_own"
STAND_FOR = {"dim_paper": "dim"}  # our initialiser -> the paper's initialiser that it repeats
CONFIDENCE = 0.95
FOLDER = Path(__file__).with_name("published")
PAPER = "volumetric"  # the paper of the method
PRINTED_NAMES = {"adc": "3DGS", "volumetric": "Ours", "sfm": "SfM", "dim": "DIM"}
# marks of measured cells beside printed numbers (`agreement`)
ROUNDING, INTERVAL, DIFFERS = "=", "≈", "≠"

FindPrinted = Callable[[str, Arm, str], str | None]  # by scene, arm and quantity: a number as text


@dataclass(frozen=True)
class PrintedTable:
    """A printed table: ``scenes`` has, for each quantity, the printed text of each arm.

    Arms are pairs of the names of an initialiser and a densifier.
    """

    quantities: Sequence[str]
    arms: Sequence[tuple[str, str]]
    scenes: Mapping[str, Sequence[Sequence[str]]]

    def find(self, scene: str, init: str, densify: str, key: str) -> str | None:
        """The number of an arm as text, whose digits tell its rounding; None if not printed."""
        of_scene = dict(zip(self.quantities, self.scenes.get(scene, ()), strict=False))
        return dict(zip(self.arms, of_scene.get(key, ()), strict=False)).get((init, densify))


@dataclass(frozen=True)
class Published:
    """A paper's numbers.

    - ``source``: where the numbers were read.
    - ``conventions``: of the measurement, as far as the source states them.
    - ``setup``: what it says on settings, by topic.
    - ``contradictions``: a sentence on each place where it contradicts itself.
    """

    title: str
    source: str
    conventions: str
    setup: Mapping[str, str]
    tables: Mapping[str, PrintedTable]
    contradictions: Sequence[str] = ()

    @property
    def setup_words(self) -> str:
        return " ".join(f"The paper on {topic}: it {words}." for topic, words in self.setup.items())


def published_names() -> list[str]:
    """The names of the papers whose numbers ship with gsbench."""
    return sorted(file.stem for file in FOLDER.glob("*.yaml"))


@cache
def load_published(name: str = PAPER) -> Published:
    """The numbers of the paper ``name``; raises InputError for an unknown name."""
    names = published_names()
    if name not in names:
        raise InputError(
            f"no published numbers {name!r}{did_you_mean(name, names)} (there are: "
            f"{', '.join(names)})"
        )
    content = yaml.safe_load((FOLDER / f"{name}.yaml").read_text("utf-8"))
    tables = {
        table: PrintedTable(**printed | {"arms": list(map(tuple, printed["arms"]))})
        for table, printed in content["tables"].items()
    }
    return Published(**content | {"tables": tables})


def layout_of(name: str) -> str | None:
    """The paper's table that the experiment repeats (``table1`` for ``table1_own``), or None."""
    table = name.removesuffix(OWN)
    return table if table in load_published().tables else None


def paper_tables(
    experiment: Experiment,
    name: str,
    trials: Sequence[TrialResult] | None = None,
    metrics: Sequence[str] | None = None,
    comparison: Comparison | None = None,
) -> list[Table]:
    """The measured table in the paper's layout, and that of differences from its numbers.

    ``name`` is ``table1`` or ``table2``. If only one initialiser was run and it is not DIM, it
    replaces DIM in Table 1.
    """
    paper = load_published()
    printed = paper.tables[name]
    trials = list(experiment.trials if trials is None else trials)
    inits = {trial.init for trial in trials}
    # the paper's initialiser -> ours
    run_as = {of_paper: _run_as(of_paper, inits) for of_paper, _ in printed.arms}
    notes = []
    if name == "table1" and run_as["dim"] not in inits and len(inits) == 1:
        (run_as["dim"],) = inits
        notes = [
            f"Initial clouds from {run_as['dim']} replace the paper's DIM: the columns do not "
            "repeat its experiment."
        ]
    shown = [(run_as[init], densify) for init, densify in printed.arms]
    trials = [trial for trial in trials if (trial.init, trial.densify) in shown]
    if not trials:
        needed = ", ".join(f"init={init} densify={densify}" for init, densify in shown)
        raise InputError(
            f"experiment {experiment.name!r} has no trial for {name} ({needed}); use --layout plain"
        )
    scenes = list(printed.scenes)
    scenes += sorted({trial.scene for trial in trials} - set(scenes))
    columns = ("densify",) if name == "table1" else ("init", "densify")
    metrics = metrics or printed.quantities
    title = name.replace("table", "Table ")
    measured = build_table(
        experiment,
        trials,
        rows=("scene",),
        columns=columns,
        metrics=metrics,
        title=f"{title}, measured (experiment {experiment.name})",
        order=([(scene,) for scene in scenes], [arm[-len(columns) :] for arm in shown]),
        comparison=comparison,
        names=PRINTED_NAMES
        | {own: PRINTED_NAMES[of_paper] for of_paper, own in run_as.items() if own in STAND_FOR},
    )
    papers_init = {own: init for init, own in run_as.items()}
    keys = [metric.key for metric in choose_quantities(trials, metrics)]
    compared = [key for key in keys if key in printed.quantities]
    if left_out := [key for key in keys if key not in compared]:
        notes.append(f"Not compared, since the paper prints no such number: {', '.join(left_out)}.")

    def find(scene: str, arm: Arm, key: str) -> str | None:
        return printed.find(scene, papers_init[arm.init], arm.densify, key)

    title = f"{title}, difference from the printed values"
    below = " ".join(notes), paper.setup_words
    return [measured, _differences(title, "paper", trials, scenes, compared, find, below)]


def _run_as(init: str, inits: set[str]) -> str:
    """Our initialiser for the paper's ``init``: that of this name, or one that repeats it."""
    if init in inits:
        return init
    return next((own for own in sorted(inits) if STAND_FOR.get(own) == init), init)


def published_table(trials: Sequence[TrialResult], name: str) -> Table:
    """The measured arms on the paper's scenes, its printed numbers, and the differences.

    Raises InputError if no trial is of a scene of the paper, or if a cell would average unlike
    trials.
    """
    paper = load_published(name)
    printed = next(iter(paper.tables.values()))
    scenes = list(printed.scenes)
    own = [trial for trial in trials if trial.scene in scenes]
    if not own:
        raise InputError(
            f"{name} has the scenes {', '.join(scenes)}, and no trial here is of one of them"
        )
    notes = [
        f"{paper.title}.",
        f"Read from {paper.source}.",
        f"Conventions: {paper.conventions}.",
    ]
    densifiers = [densify for _, densify in printed.arms]
    if len(densifiers) == 1:
        notes.append(
            f"The printed numbers are of densify={densifiers[0]}; other arms are shown for "
            "orientation."
        )

    def find(scene: str, arm: Arm, key: str) -> str | None:
        of_paper = printed.arms[0] if len(printed.arms) == 1 else (arm.init, arm.densify)
        return printed.find(scene, *of_paper, key)

    below = " ".join(notes), paper.setup_words
    return _differences(
        f"Difference from {name}", name, own, scenes, printed.quantities, find, below
    )


def _differences(
    title: str,
    paper: str,
    trials: Sequence[TrialResult],
    scenes: Sequence[str],
    keys: Sequence[str],
    find: FindPrinted,
    notes: Sequence[str],
) -> Table:
    """A table with a row per scene and arm: the printed number, and measured minus printed."""
    shown = [quantity(key, trials) for key in keys]
    expected = len({trial.seed for trial in trials})
    marks: Counter[str] = Counter()
    rows = []
    ordered = sorted(trials, key=lambda trial: scenes.index(trial.scene))
    for (scene, arm), group in group_by(ordered, "scene", "arm").items():
        check_averageable(group, f"scene={scene} init={arm.init} densify={arm.densify}")
        entries: list[TableEntry] = []
        for one in shown:
            cell, printed = make_cell(group, one, [scene], expected), find(scene, arm, one.key)
            entry = TableEntry("—")
            if printed and cell.mean is not None:
                mark = agreement(cell, printed)
                marks[mark] += 1
                decimals = max(one.decimals, len(printed.partition(".")[2]))
                change = signed(cell.mean - float(printed), f".{decimals}f")
                entry = TableEntry(f"{change} {mark}", cell=cell)
            entries += [TableEntry(printed or ""), entry]
        rows.append(Row((scene, arm.init, str(replace(arm, init=""))), tuple(entries)))
    columns = [
        Column(one.name, heading, (one.key, key))
        for one in shown
        for heading, key in ((paper, paper), ("Δ", "delta"))
    ]
    legend = (
        f"Δ is measured minus printed. Of {marks.total()} cells {marks[ROUNDING]} are within "
        f"rounding ({ROUNDING}), {marks[INTERVAL]} within our {CONFIDENCE:.0%} t interval of the "
        f"mean ({INTERVAL}), {marks[DIFFERS]} differ ({DIFFERS}). The paper prints no deviation, "
        "so the spread of its own trials is not taken into account; a single trial has no interval."
    )
    below = tuple(filter(None, (legend, *notes)))
    return Table(title, ("scene", "init", "densify"), tuple(columns), tuple(rows), below)


def agreement(cell: Cell, printed: str) -> str:
    """The mark of a measured cell: ``=``, ``≈`` or ``≠``.

    ``=`` if its mean is in the printed number's range, half a unit of its last digit on both sides;
    ``≈`` if its interval overlaps the range, else ``≠``. A single trial has no interval.
    """
    assert cell.mean is not None
    value, half = float(printed), 0.5 * 10.0 ** -len(printed.partition(".")[2])
    low, high = value - half, value + half
    if low <= cell.mean <= high:
        return ROUNDING
    if cell.std is None:
        return DIFFERS
    error = cell.std / math.sqrt(cell.count)
    own = StudentT(cell.mean, error, cell.count - 1).interval(1 - CONFIDENCE)
    return INTERVAL if own.low <= high and own.high >= low else DIFFERS
