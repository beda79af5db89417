"""A static site from archives of results: a page of arms and scenes with all verdicts, and a report of each archive.

Archives are strangers' files: their words come into the pages as text alone, and into no name of a file.
"""

import base64
import hashlib
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path

from gsbench.analysis.cells import swept_settings
from gsbench.analysis.declaration import active_declaration
from gsbench.analysis.judgement import Verdict, judge
from gsbench.analysis.notes import compared_pairs
from gsbench.analysis.report.build import build_report
from gsbench.analysis.results import Experiment
from gsbench.analysis.table_formats import Table, fill
from gsbench.analysis.tables import build_table
from gsbench.analysis.verdicts import headline, judge_pairs
from gsbench.claims.archive import unpack_archive
from gsbench.errors import InputError
from gsbench.runs.declaration import read_declarations, standing_one

INDEX, REPORTS = "index.html", "reports"


@dataclass(frozen=True)
class Part:
    """An archive's part of the first page."""

    name: str
    key: str  # in names of files and anchors: letters, digits, - and _
    facts: tuple[tuple[str, str], ...]
    claims: tuple[Verdict, ...]  # declared ones, with their verdicts
    lines: tuple[str, ...]  # verdicts on every two arms that are compared
    tables: tuple[Table, ...]  # of arms × scenes, one for each quantity
    notes: tuple[str, ...] = ()


def write_site(archives: Sequence[Path], out: Path, title: str, scratch: Path) -> list[str]:
    """Write the site into the folder ``out``; returns a line for each archive that is left out, with the reason.

    ``scratch`` is an empty folder for what is unpacked. Raises InputError where no archive can be read.
    """
    parts: list[Part] = []
    left_out: list[str] = []
    (out / REPORTS).mkdir(parents=True, exist_ok=True)
    for number, archive in enumerate(archives):
        try:
            experiment = unpack_archive(archive, scratch / str(number))
            key = _key(experiment.name, {part.key for part in parts})
            report, part = build_report(experiment), _part(experiment, key)
        except InputError as error:
            left_out.append(str(error))
            continue
        (out / REPORTS / f"{key}.html").write_text(report, encoding="utf-8")
        parts.append(part)
    if not parts:
        raise InputError(f"no archive can be shown ({left_out[0]})")
    script = files("gsbench.claims").joinpath("site.js").read_text(encoding="utf-8")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    values = {"title": title, "parts": parts, "left_out": left_out, "script": script, "script_hash": digest}
    page = fill("site.html.j2", "gsbench.claims", **values)
    (out / INDEX).write_text(page, encoding="utf-8")
    return left_out


def _part(experiment: Experiment, key: str) -> Part:
    trials, notes = experiment.trials, list[str]()
    claims: tuple[Verdict, ...] = ()
    tables: tuple[Table, ...] = ()
    try:
        claims = _claims(experiment)
    except InputError as error:
        notes.append(f"Its declared claims cannot be judged: {error}")
    try:
        rows = ("init", "densify", *swept_settings(trials))
        tables = tuple(_by_quantity(build_table(experiment, rows=rows, columns=("scene",))))
    except InputError as error:
        notes.append(f"No table: {error}")
    arms, pairs = compared_pairs(experiment)
    judged = judge_pairs(arms, pairs, active_declaration(experiment.folder, trials))
    facts = {
        "trials": str(len(trials)),
        "scenes": ", ".join(sorted({trial.scene for trial in trials})),
        "seeds": ", ".join(map(str, experiment.seeds)),
        "protocol": ", ".join(sorted({trial.record.protocol for trial in trials})),
        "iterations": ", ".join(map(str, sorted({trial.record.iterations for trial in trials}))),
        "machine": ", ".join(sorted({trial.machine or "not recorded" for trial in trials})),
        "gsbench": ", ".join(sorted({trial.record.versions.get("gsbench", "unknown") for trial in trials})),
    }
    lines = tuple(headline(own) for own in judged)
    return Part(experiment.name, key, tuple(facts.items()), claims, lines, tables, tuple(notes))


def _claims(experiment: Experiment) -> tuple[Verdict, ...]:
    """The verdicts on claims that were declared, as `gsbench check --from` makes them; of a gate half is elsewhere."""
    declared = [one for one in read_declarations(experiment.folder) if one.of_claims]
    if not declared:
        return ()
    judged = judge(experiment.trials, standing_one(declared))
    return tuple(verdict for verdict in judged if not verdict.question.versions)


def _by_quantity(table: Table) -> Iterator[Table]:
    """A table of arms × scenes for each quantity of one that has all."""
    end = 0
    for name, size in table.groups:
        kept = slice(end, end + size)
        end += size
        columns = tuple(replace(column, group="") for column in table.columns[kept])
        rows = tuple(replace(row, entries=row.entries[kept], rule_above=False) for row in table.rows)
        yield replace(table, title=name, columns=columns, rows=rows, notes=())


def _key(name: str, taken: set[str]) -> str:
    """A name of a file that no other archive has, also where capitals are no difference."""
    plain = re.sub(r"[^a-z0-9_-]+", "-", name.lower()).strip("-") or "experiment"
    return next(key for n in range(1, len(taken) + 2) if (key := plain if n == 1 else f"{plain}-{n}") not in taken)
