"""Published numbers of other papers as data, one YAML a paper, and a table that holds ours against them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files

import yaml

from gsbench.analysis.cells import check_averageable, make_cell
from gsbench.analysis.paper import Agreement, Printed, compare_with_printed, legend, setup_lines
from gsbench.analysis.quantities import quantity
from gsbench.analysis.results import TrialResult, by_key
from gsbench.analysis.tables import Column, Entry, Row, Table
from gsbench.errors import InputError
from gsbench.words import closest


@dataclass(frozen=True)
class Published:
    """One paper's numbers; ``printed`` maps (scene, quantity) to what its method has there."""

    name: str
    title: str
    source: str  # where the numbers were read
    conventions: str  # under which they were measured, as far as the source says
    densify: str  # the densifier of ours that is the paper's method
    quantities: tuple[str, ...]
    printed: Mapping[tuple[str, str], Printed]
    setup: Mapping[str, str]


def published_names() -> list[str]:
    """The papers that ship with gsbench."""
    folder = files("gsbench.analysis.published")
    return sorted(entry.name.removesuffix(".yaml") for entry in folder.iterdir() if entry.name.endswith(".yaml"))


@cache
def load_published(name: str) -> Published:
    """The numbers of the paper ``name``; raises InputError that lists the papers there are."""
    known = published_names()
    if name not in known:
        raise InputError(f"no published numbers {name!r}{closest(name, known)} (there are: {', '.join(known)})")
    content = yaml.safe_load(files("gsbench.analysis.published").joinpath(f"{name}.yaml").read_text(encoding="utf-8"))
    quantities = tuple(content["quantities"])
    printed = {
        (scene, key): Printed(text)
        for scene, texts in content["scenes"].items()
        for key, text in zip(quantities, texts, strict=True)
    }
    title, source, conventions = (" ".join(content[key].split()) for key in ("title", "source", "conventions"))
    return Published(name, title, source, conventions, content["densify"], quantities, printed, content["setup"])


def published_table(trials: Sequence[TrialResult], name: str) -> Table:
    """Table of our arms on the paper's scenes beside the printed numbers, with the differences.

    Raises InputError where no trial is of a scene of the paper, or where a cell would mix what may not be averaged.
    """
    paper = load_published(name)
    scenes = list(dict.fromkeys(scene for scene, _ in paper.printed))
    own = sorted((trial for trial in trials if trial.scene in scenes), key=lambda trial: scenes.index(trial.scene))
    if not own:
        raise InputError(f"{name} has the scenes {', '.join(scenes)}, and no trial here is of one of them")
    shown = [quantity(key, own) for key in paper.quantities]
    tally: Counter[Agreement] = Counter()
    rows = []
    for (scene, arm), group in by_key(own, lambda trial: (trial.scene, trial.arm)).items():
        check_averageable(group, f"scene={scene} init={arm.init} densify={arm.densify}")
        entries: list[Entry] = []
        for one in shown:
            cell = make_cell(group, one, [scene], len({trial.seed for trial in own}))
            entries += compare_with_printed(cell, paper.printed.get((scene, one.key)), one, tally)
        rows.append(Row((scene, arm.init, str(replace(arm, init=""))), tuple(entries)))
    heads = tuple(Column(one.name, heading) for one in shown for heading in (name, "Δ"))
    method = f"The printed numbers are of densify={paper.densify}; other arms are shown for orientation."
    notes = [f"{paper.title}.", f"Read from {paper.source}.", f"Conventions: {paper.conventions}.", method]
    notes += setup_lines(paper.setup)
    keys = tuple((one.key, heading) for one in shown for heading in (name, "delta"))
    return Table(
        f"Difference from {name}", ("scene", "init", "densify"), heads, tuple(rows), (legend(tally), *notes), keys
    )
