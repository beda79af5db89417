"""A static site from archives: a first page with all verdicts, and a report of each archive.

Archives may come from strangers: their texts are escaped in pages, and never used in names of
files.
"""

import re
from collections.abc import Callable, Container, Sequence
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

from gsbench.analysis.cells import swept_settings
from gsbench.analysis.comparison import compare
from gsbench.analysis.quantities import choose_quantities
from gsbench.analysis.report.build import build_report
from gsbench.analysis.results import Experiment, TrialResult
from gsbench.analysis.table_formats import Table, fill
from gsbench.analysis.tables import build_table
from gsbench.claims.archive import unpack_archive
from gsbench.errors import InputError
from gsbench.files import own_output, write_text

INDEX, REPORTS = "index.html", "reports"
FACTS: dict[str, Callable[[TrialResult], Any]] = {
    "scenes": lambda trial: trial.scene,
    "seeds": lambda trial: trial.seed,
    "protocol": lambda trial: trial.record.protocol,
    "iterations": lambda trial: trial.record.iterations,
    "machine": lambda trial: trial.machine or "not recorded",
    "gsbench": lambda trial: trial.record.versions.get("gsbench", "unknown"),
}


def write_site(archives: Sequence[Path], out: Path, title: str, scratch: Path) -> list[str]:
    """Write the site into ``out``; return a line with the reason for each archive left out.

    Archives are unpacked into the empty folder ``scratch``. Raises InputError if no archive can be
    shown.
    """
    sections: list[dict[str, Any]] = []
    left_out: list[str] = []
    (out / REPORTS).mkdir(parents=True, exist_ok=True)
    for number, archive in enumerate(archives):
        try:
            experiment = unpack_archive(archive, scratch / str(number))
            key = _unique_key(experiment.name, {section["key"] for section in sections})
            report, section = build_report(experiment), _section(experiment, key)
        except InputError as error:
            left_out.append(str(error))
            continue
        with own_output(file := out / REPORTS / f"{key}.html"):
            write_text(file, report)
        sections.append(section)  # only now: a section links to its report
    if not sections:
        raise InputError(f"no archive can be shown ({left_out[0]})")
    script = files("gsbench.claims").joinpath("site.js").read_text(encoding="utf-8")
    values = {"title": title, "sections": sections, "left_out": left_out, "script": script}
    page = fill("site.html.j2", "gsbench.claims", **values)
    with own_output(out / INDEX):
        write_text(out / INDEX, page)
    return left_out


def _section(experiment: Experiment, key: str) -> dict[str, Any]:
    """An experiment's section of the first page; ``key`` is for names of files and anchors.

    It has a line on each idea, and a table of arms × scenes for each quantity.
    """
    trials, notes, comparison = experiment.trials, list[str](), compare(experiment)
    tables: list[Table] = []
    try:
        rows = ("init", "densify", *swept_settings(trials))
        # the metrics that were asked about come first
        asked = {answer.verdict.quantity.key for answer in comparison.answers}
        for one in sorted(choose_quantities(trials), key=lambda one: one.key not in asked):
            table = build_table(
                experiment,
                rows=rows,
                columns=("scene",),
                metrics=[one.key],
                title=one.heading,
                comparison=comparison,
            )
            shown = tuple(replace(column, group="") for column in table.columns)  # it is the title
            tables.append(replace(table, columns=shown, notes=()))
    except InputError as error:
        notes.append(f"No table: {error}")
    facts = {"trials": str(len(trials))}
    for name, read in FACTS.items():
        facts[name] = ", ".join(map(str, sorted(set(map(read, trials)))))
    return {
        "name": experiment.name,
        "key": key,
        "facts": list(facts.items()),
        "lines": comparison.sentences,
        "tables": tables,
        "notes": [*notes, *comparison.remarks, *experiment.warnings],
    }


def _unique_key(name: str, taken: Container[str]) -> str:
    """A key in lower case that is not ``taken``: file systems may not distinguish capitals."""
    key = re.sub(r"[^a-z0-9_-]+", "-", name.lower()).strip("-") or "experiment"
    while key in taken:
        key += "-2"
    return key
