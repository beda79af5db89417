"""Tables as plain data, and their formats: Markdown, CSV, LaTeX (booktabs) and HTML."""

from __future__ import annotations

import base64
import hashlib
import itertools
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

from gsbench.analysis.cells import Cell
from gsbench.parsing import table_beside
from gsbench.words import markdown_text, printable

if TYPE_CHECKING:
    import pandas as pd

TEMPLATES = "gsbench.analysis.report"
MOST_NOTES = 5  # lines below a table, beside its verdicts


@dataclass(frozen=True)
class TableEntry:
    """A table cell: its ``text`` without markup, and the ``cell`` behind it if it is a number."""

    text: str
    bold: bool = False
    cell: Cell | None = None


@dataclass(frozen=True)
class Column:
    """A column: group (the quantity), heading, and both for machines (``key``)."""

    group: str
    heading: str
    key: tuple[str, str]


@dataclass(frozen=True)
class Row:
    labels: tuple[str, ...]
    entries: tuple[TableEntry, ...]
    rule_above: bool = False


@dataclass(frozen=True)
class Table:
    """A titled table with the ``verdicts`` on its arms and notes below it.

    ``notes`` come in the order of their weight, and at most `MOST_NOTES` lines are shown. The cells
    of a ``wrapped`` table may need several lines.
    """

    title: str
    row_headings: tuple[str, ...]
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()
    wrapped: bool = False
    verdicts: tuple[str, ...] = ()

    @property
    def shown_notes(self) -> tuple[str, ...]:
        """The first notes; the last line says how many others there are."""
        if len(self.notes) <= MOST_NOTES:
            return self.notes
        first = self.notes[: MOST_NOTES - 1]
        return (*first, f"{len(self.notes) - len(first)} more notes: in the report.")

    @property
    def groups(self) -> list[tuple[str, int]]:
        """Neighbouring columns of one group, as (name, number of columns)."""
        groups = itertools.groupby(self.columns, key=lambda column: column.group)
        return [(name, len(list(group))) for name, group in groups]


def text_table(
    title: str,
    heading: str,
    columns: Iterable[object],
    rows: Mapping[str, Iterable[str]],
    ruled: int | None = None,
    **more: Any,
) -> Table:
    """A table of texts with a label before each row; the row number ``ruled`` is below a rule."""
    made = [
        Row((label,), tuple(map(TableEntry, texts)), rule_above=number == ruled)
        for number, (label, texts) in enumerate(rows.items())
    ]
    names = tuple(Column("", str(name), ("", str(name))) for name in columns)
    return Table(title, (heading,), names, tuple(made), **more)


def fill(template: str, package: str = TEMPLATES, **values: Any) -> str:
    """Fill a jinja2 template of ``package``, or else of the report, with ``values``.

    Values are escaped for HTML, and `printable`: a name could turn the sentence after it around.
    """
    return _environment(package).get_template(template).render(**values)


@cache
def _environment(package: str) -> Environment:
    loader = ChoiceLoader([PackageLoader(package, ""), PackageLoader(TEMPLATES, "")])
    environment = Environment(
        loader=loader,
        autoescape=True,
        finalize=lambda value: printable(value) if type(value) is str else value,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["digest"] = _digest
    return environment


def _digest(script: str) -> str:
    """The hash by which a page's Content-Security-Policy allows its own script, and no other."""
    return base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()


# Text that a spreadsheet would compute, or start, and is no number such as +0.3 ± 0.1
FORMULA = re.compile(r"[=@]|[+-](?![\d.,\s±%()]*$)")


def csv_of(frame: pd.DataFrame) -> str:
    """The frame as CSV, in which no text is a formula: an apostrophe precedes it."""

    def plain(value: Any) -> Any:
        if not isinstance(value, str):
            return value
        return ("'" if FORMULA.match(value.lstrip()) else "") + printable(value)

    return frame.map(plain).rename(columns=plain).to_csv(index=False, lineterminator="\n")


def to_markdown(table: Table) -> str:
    """A GitHub-flavoured Markdown table under its title, with its notes as a list."""
    heads = [
        *table.row_headings,
        *(f"{column.group} {column.heading}".strip() for column in table.columns),
    ]
    rule = [":---"] * len(table.row_headings) + ["---:"] * len(table.columns)
    rows = [
        [*row.labels, *(f"**{e.text}**" if e.bold else e.text for e in row.entries)]
        for row in table.rows
    ]
    lines = [
        " | ".join(markdown_text(text).replace("|", "\\|") for text in row)
        for row in (heads, rule, *rows)
    ]
    notes = [f"- {markdown_text(line)}" for line in (*table.verdicts, *table.shown_notes)]
    title = f"### {markdown_text(table.title)}"
    return "\n".join([title, "", *(f"| {line} |" for line in lines), "", *notes]).rstrip() + "\n"


def to_csv(table: Table) -> str:
    """CSV with one line per cell: values in full precision, text, and trials' folders."""
    import pandas as pd  # here, since it is slow to import

    heads = [
        *table.row_headings,
        "quantity",
        "column",
        "mean",
        "std",
        "count",
        "expected",
        "best",
        "text",
        "trials",
    ]
    lines: list[list[object]] = []
    for row in table.rows:
        for column, entry in zip(table.columns, row.entries, strict=True):
            cell = entry.cell
            numbers = (
                [None] * 4 if cell is None else [cell.mean, cell.std, cell.count, cell.expected]
            )
            trials = "" if cell is None else " ".join(trial.label for trial in cell.trials)
            lines.append([*row.labels, *column.key, *numbers, int(entry.bold), entry.text, trials])
    return csv_of(pd.DataFrame(lines, columns=heads, dtype=object))


def to_latex(table: Table) -> str:
    """A ``table`` environment in booktabs style; the document needs ``\\usepackage{booktabs}``."""
    import pandas as pd  # here, since it is slow to import

    columns = "r" * len(table.columns)
    if table.wrapped:
        share = f"{WRAPPED_SHARE / len(table.columns):.2f}"
        columns = f">{{\\raggedright\\arraybackslash}}p{{{share}\\linewidth}}" * len(table.columns)
    heads = [("", name) for name in table.row_headings] + [
        (column.group, column.heading) for column in table.columns
    ]
    heads = [(escape_latex(group), escape_latex(name)) for group, name in heads]
    grouped = any(group for group, _ in heads)
    rows = [[*map(escape_latex, row.labels), *map(_latex_text, row.entries)] for row in table.rows]
    frame = pd.DataFrame(
        rows, columns=pd.MultiIndex.from_tuples(heads) if grouped else [name for _, name in heads]
    )
    text = frame.to_latex(
        index=False,
        escape=False,
        multicolumn_format="c",
        column_format="l" * len(table.row_headings) + columns,
        caption=escape_latex(table.title),
    ).replace("\\begin{table}\n", "\\begin{table}\n\\centering\n")
    if below := (*table.verdicts, *table.shown_notes):
        notes = "\\\\\n".join(map(escape_latex, below))
        start = "\\par\\smallskip\\begin{minipage}{\\linewidth}\\footnotesize"
        added = f"{start}\n{notes}\n\\end{{minipage}}\n"
        text = text.replace("\\end{table}", f"{added}\\end{{table}}")
    needs = f"% needs \\usepackage{{booktabs{',array' if table.wrapped else ''}}}\n"
    if foreign := "".join(sorted({letter for letter in text if ord(letter) > LATIN_1})):
        needs += f"% needs xelatex or lualatex, and a font with {foreign}\n"
    return needs + text


def to_html_page(table: Table) -> str:
    """The table as a page of its own, in the style of reports."""
    return fill("table_page.html.j2", table=table)


FORMATS: dict[str, tuple[str, Callable[[Table], str]]] = {  # name -> file suffix, writer
    "md": ("md", to_markdown),
    "csv": ("csv", to_csv),
    "latex": ("tex", to_latex),
    "html": ("html", to_html_page),
}

LATIN_1 = 255  # the last character that pdflatex has in its usual fonts
WRAPPED_SHARE = 0.7  # share of a LaTeX line for the columns of a ``wrapped`` table

_LATEX = str.maketrans(table_beside(__file__, "latex.yaml"))


def escape_latex(text: str) -> str:
    """Text as LaTeX source."""
    return printable(" ".join(text.split())).translate(_LATEX)


def _latex_text(entry: TableEntry) -> str:
    text = escape_latex(entry.text)
    return f"\\textbf{{{text}}}" if entry.bold else text
