"""The paper's printed Tables 1 and 2 as data, the same tables from one's own trials, and how far they lie apart."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cache
from importlib.resources import files

import yaml

from gsbench.analysis.cells import Cell
from gsbench.analysis.quantities import Quantity, quantity
from gsbench.analysis.results import Experiment, TrialResult
from gsbench.analysis.tables import Column, Entry, Row, Table, build_table
from gsbench.errors import InputError
from gsbench.words import signed

PAPER_TABLES = ("table1", "table2")
OWN = "_own"  # ends the name of the same table with poses and gauge of each initialiser's own
STAND_FOR = {"dim_paper": "dim"}  # initialisers that are one of the paper's arms under another name
CONFIDENCE = 0.95
TABLE1_QUANTITIES = ("ssim", "psnr", "lpips_vgg_raw", "gaussians_millions", "train_minutes")
TABLE1_ARMS = (("dim", "adc"), ("dim", "volumetric"))
TABLE2_ARMS = (("sfm", "adc"), ("dim", "adc"), ("sfm", "volumetric"), ("dim", "volumetric"))
ARM_NAMES = {"adc": "3DGS", "volumetric": "Ours"}
INIT_NAMES = {"sfm": "SfM", "dim": "DIM"}


@dataclass(frozen=True)
class Printed:
    """A printed number; it stands for anything within half a step of its last digit."""

    text: str

    @property
    def value(self) -> float:
        return float(self.text)

    @property
    def half_step(self) -> float:
        _, _, digits = self.text.partition(".")
        return 0.5 * 10.0 ** -len(digits)

    @property
    def range(self) -> tuple[float, float]:
        return self.value - self.half_step, self.value + self.half_step


Key = tuple[str, str, str, str]  # scene, init, densify, quantity


@dataclass(frozen=True)
class Paper:
    """Both tables: ``table1`` and ``table2`` map (scene, init, densify, quantity) to the printed number."""

    table1: Mapping[Key, Printed]
    table2: Mapping[Key, Printed]
    contradictions: tuple[str, ...]  # of the paper with itself, a sentence each
    setup: Mapping[str, str]  # its words on settings beside the method

    def table(self, name: str) -> Mapping[Key, Printed]:
        return {"table1": self.table1, "table2": self.table2}[name]

    def scenes(self, name: str) -> list[str]:
        """The scenes of a table in the printed order."""
        return list(dict.fromkeys(key[0] for key in self.table(name)))


@cache
def load_paper() -> Paper:
    """The paper's tables from the file that ships with the package."""
    content = yaml.safe_load(files("gsbench.analysis").joinpath("paper.yaml").read_text(encoding="utf-8"))
    table1: dict[Key, Printed] = {}
    for scene, (_, *pairs) in content["table1"]["scenes"].items():
        for key, pair in zip(TABLE1_QUANTITIES, pairs, strict=True):
            for (init, densify), text in zip(TABLE1_ARMS, pair, strict=True):
                table1[scene, init, densify, key] = Printed(text)
    table2 = {
        (scene, init, densify, "lpips_vgg_raw"): Printed(text)
        for scene, texts in content["table2"]["scenes"].items()
        for (init, densify), text in zip(TABLE2_ARMS, texts, strict=True)
    }
    return Paper(table1, table2, tuple(content["contradictions"]), content["setup"])


def setup_lines(setup: Mapping[str, str]) -> list[str]:
    """Say in a line each what a paper writes on settings beside its method, to be held against one's own."""
    return [f"The paper on {topic}: it {words}." for topic, words in setup.items()]


class Agreement(Enum):
    """Classes of agreement between a measured cell and the printed number, from the closest to the farthest."""

    ROUNDING = "="  # the mean lies within half a step of the last printed digit
    INTERVAL = "≈"  # our t interval meets the range that the printed number stands for
    DIFFERS = "≠"


def paper_tables(
    experiment: Experiment, name: str, trials: Sequence[TrialResult] | None = None, metrics: Sequence[str] | None = None
) -> list[Table]:
    """The measured table in the paper's layout and the table of differences from the printed numbers."""
    trials = list(experiment.trials if trials is None else trials)
    arms, notes = _arms(name, trials)
    trials = [trial for trial in trials if (trial.init, trial.densify) in arms]
    if not trials:
        needed = ", ".join(f"init={init} densify={densify}" for init, densify in arms)
        raise InputError(f"experiment {experiment.name!r} has no trial for {name} ({needed}); use --layout plain")
    scenes = load_paper().scenes(name)
    scenes += sorted({trial.scene for trial in trials} - set(scenes))
    columns = ("densify",) if name == "table1" else ("init", "densify")
    measured = build_table(
        experiment,
        trials,
        rows=("scene",),
        columns=columns,
        metrics=metrics or (TABLE1_QUANTITIES if name == "table1" else ("lpips_vgg_raw",)),
        title=f"{name.replace('table', 'Table ')}, measured (experiment {experiment.name})",
        order=([(scene,) for scene in scenes], [arm[-len(columns) :] for arm in arms]),
        names=ARM_NAMES | INIT_NAMES | {init: INIT_NAMES[known] for init, known in STAND_FOR.items()},
    )
    return [measured, _differences(name, measured, arms, trials, notes)]


def layout_of(name: str) -> str | None:
    """The paper's table that the experiment ``name`` repeats, by its name: ``table1`` for ``table1_own``, too."""
    table = name.removesuffix(OWN)
    return table if table in PAPER_TABLES else None


def agreement(cell: Cell, printed: Printed) -> Agreement:
    """Class a measured cell against a printed number; a single trial has no interval."""
    assert cell.mean is not None
    if abs(cell.mean - printed.value) <= printed.half_step:
        return Agreement.ROUNDING
    if cell.std is not None:
        half = t_half_width(cell.std, cell.count)
        low, high = printed.range
        if cell.mean - half <= high and cell.mean + half >= low:
            return Agreement.INTERVAL
    return Agreement.DIFFERS


def compare_with_printed(
    cell: Cell | None, printed: Printed | None, shown: Quantity, tally: Counter[Agreement]
) -> list[Entry]:
    """The printed number, and how far the measured cell is from it; how they agree is added to ``tally``."""
    if printed is None or cell is None or cell.mean is None:
        return [Entry(printed.text if printed else ""), Entry("—")]
    found = agreement(cell, printed)
    tally[found] += 1
    decimals = max(shown.decimals, len(printed.text.partition(".")[2]))
    delta = signed(cell.mean - printed.value, f".{decimals}f")
    return [Entry(printed.text), Entry(f"{delta} {found.value}", cell=cell)]


def legend(tally: Counter[Agreement]) -> str:
    """Explain the marks, with the number of cells that have each."""
    return (
        f"Δ is measured minus printed. Of {sum(tally.values())} cells {tally[Agreement.ROUNDING]} are within rounding "
        f"(=), {tally[Agreement.INTERVAL]} within our {CONFIDENCE:.0%} t interval of the mean (≈), "
        f"{tally[Agreement.DIFFERS]} differ (≠). The paper prints no deviation, so the spread of its own trials is not "
        "taken into account; a single trial has no interval."
    )


def t_half_width(std: float, count: int) -> float:
    """Half the width of Student's 95 % interval of a mean of ``count`` values."""
    from scipy.special import stdtrit  # here, for a quick start of what needs no interval

    return float(stdtrit(count - 1, 0.5 + CONFIDENCE / 2)) * std / math.sqrt(count)


def _arms(name: str, trials: Sequence[TrialResult]) -> tuple[list[tuple[str, str]], list[str]]:
    """The (init, densify) arms of a table; where DIM was not run and one other initialiser was, that one stands in."""
    inits = {trial.init for trial in trials}
    arms = [(_run_as(init, inits), densify) for init, densify in (TABLE1_ARMS if name == "table1" else TABLE2_ARMS)]
    if name == "table1" and arms[0][0] not in inits and len(inits) == 1:
        other = inits.pop()
        note = f"Initial clouds from {other} replace the paper's DIM: the columns do not repeat its experiment."
        return [(other, densify) for _, densify in TABLE1_ARMS], [note]
    return arms, []


def _run_as(init: str, inits: set[str]) -> str:
    """The initialiser that stands for the paper's ``init``: itself, unless only another of that kind was run."""
    others = [other for other in sorted(inits) if init not in inits and STAND_FOR.get(other) == init]
    return others[0] if others else init


def _differences(
    name: str, measured: Table, arms: Sequence[tuple[str, str]], trials: Sequence[TrialResult], notes: Sequence[str]
) -> Table:
    paper = load_paper()
    printed_table = paper.table(name)
    paper_arms = dict(zip(arms, TABLE1_ARMS if name == "table1" else TABLE2_ARMS, strict=True))
    keys = list(dict.fromkeys(key for key, _ in measured.keys))
    compared = [key for key in keys if any(printed[3] == key for printed in printed_table)]
    quantities = {key: quantity(key, trials) for key in compared}
    tally: Counter[Agreement] = Counter()
    rows = []
    for row in measured.rows:
        scene = row.labels[0]
        for place, arm in enumerate(arms):
            entries = []
            for key in compared:
                cell = row.entries[keys.index(key) * len(arms) + place].cell
                printed = printed_table.get((scene, *paper_arms[arm], key))
                entries += compare_with_printed(cell, printed, quantities[key], tally)
            if any(entry.cell is not None for entry in entries):
                rows.append(Row((scene, _arm_name(name, paper_arms[arm])), tuple(entries)))
    heads = tuple(Column(quantities[key].name, heading) for key in compared for heading in ("paper", "Δ"))
    left_out = [key for key in keys if key not in compared]
    if left_out:
        notes = [*notes, f"Not compared, since the paper prints no such number: {', '.join(left_out)}."]
    return Table(
        f"{name.replace('table', 'Table ')}, difference from the printed values",
        ("scene", "arm"),
        heads,
        tuple(rows),
        (legend(tally), *notes, *setup_lines(paper.setup)),
        tuple((key, heading) for key in compared for heading in ("paper", "delta")),
    )


def _arm_name(name: str, arm: tuple[str, str]) -> str:
    return ARM_NAMES[arm[1]] if name == "table1" else f"{INIT_NAMES[arm[0]]} + {ARM_NAMES[arm[1]]}"
