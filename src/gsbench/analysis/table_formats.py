"""Writing a table as Markdown, CSV, LaTeX (booktabs) or HTML."""

from __future__ import annotations

import html
import itertools
import re
from collections.abc import Callable
from importlib.resources import files

from gsbench.analysis.tables import Column, Entry, Table


def to_markdown(table: Table) -> str:
    """A GitHub-flavoured Markdown table under its title, with notes as a list."""
    heads = [*table.row_headings, *(_flat_heading(column) for column in table.columns)]
    lines = [f"### {table.title}", "", _markdown_row(heads)]
    lines.append(_markdown_row([":---"] * len(table.row_headings) + ["---:"] * len(table.columns)))
    for row in table.rows:
        cells = [f"**{_pipe(e.text)}**" if e.bold else _pipe(e.text) for e in row.entries]
        lines.append(_markdown_row([*map(_pipe, row.labels), *cells]))
    lines += ["", *(f"- {note}" for note in table.notes)]
    return "\n".join(lines).rstrip() + "\n"


def to_csv(table: Table) -> str:
    """One line for each cell, in full precision, with the folders of its trials."""
    import pandas as pd  # here, since it is slow to import

    heads = [*table.row_headings, "quantity", "column", "mean", "std", "count", "expected", "best", "text", "trials"]
    cells = [
        [*row.labels, quantity, arm, *_numbers(entry), int(entry.bold), entry.text, _trials(entry)]
        for row in table.rows
        for (quantity, arm), entry in zip(table.keys, row.entries, strict=True)
    ]
    return str(pd.DataFrame(cells, columns=heads, dtype=object).to_csv(index=False, lineterminator="\n"))


def to_latex(table: Table) -> str:
    """A ``table`` environment in booktabs style; the document needs ``\\usepackage{booktabs}``."""
    import pandas as pd  # here, since it is slow to import

    columns = "r" * len(table.columns)
    if table.wrapped:
        share = f"{WRAPPED_SHARE / len(table.columns):.2f}"
        columns = f">{{\\raggedright\\arraybackslash}}p{{{share}\\linewidth}}" * len(table.columns)
    heads = [("", name) for name in table.row_headings] + [(one.group, one.heading) for one in table.columns]
    heads = [(escape_latex(group), escape_latex(name)) for group, name in heads]
    grouped = any(group for group, _ in heads)
    rows = [[*map(escape_latex, row.labels), *(_latex_text(entry) for entry in row.entries)] for row in table.rows]
    frame = pd.DataFrame(rows, columns=pd.MultiIndex.from_tuples(heads) if grouped else [name for _, name in heads])
    text = frame.to_latex(
        index=False,
        escape=False,
        multicolumn_format="c",
        column_format="l" * len(table.row_headings) + columns,
        caption=escape_latex(table.title),
    ).replace("\\begin{table}\n", "\\begin{table}\n\\centering\n")
    if table.notes:
        notes = "\\\\\n".join(escape_latex(note) for note in table.notes)
        below = f"\\par\\smallskip\\begin{{minipage}}{{\\linewidth}}\\footnotesize\n{notes}\n\\end{{minipage}}\n"
        text = text.replace("\\end{table}", f"{below}\\end{{table}}")
    return f"% needs \\usepackage{{booktabs{',array' if table.wrapped else ''}}}\n{text}"


def to_html(table: Table) -> str:
    """A ``<figure>`` with the table, its caption and notes; no styles of its own."""
    kind = "table wrapped" if table.wrapped else "table"
    parts = [f'<figure class="{kind}"><table>\n<caption>{html.escape(table.title)}</caption>\n<thead>\n']
    groups = _column_groups(table)
    grouped = any(name for name, _ in groups)
    if grouped:
        heads = "".join(f'<th scope="colgroup" colspan="{size}">{html.escape(name)}</th>' for name, size in groups)
        span = f'<td colspan="{len(table.row_headings)}"></td>'
        parts.append(f"<tr>{span}{heads}</tr>\n")
    labels = "".join(f'<th class="name" scope="col">{html.escape(name)}</th>' for name in table.row_headings)
    heads = "".join(f'<th scope="col">{html.escape(column.heading)}</th>' for column in table.columns)
    parts.append(f"<tr>{labels}{heads}</tr>\n</thead>\n<tbody>\n")
    for row in table.rows:
        labels = "".join(f'<th scope="row">{html.escape(label)}</th>' for label in row.labels)
        cells = "".join(f"<td>{_html_text(entry)}</td>" for entry in row.entries)
        rule = ' class="rule"' if row.rule_above else ""
        parts.append(f"<tr{rule}>{labels}{cells}</tr>\n")
    parts.append("</tbody>\n</table>\n")
    if table.notes:
        notes = "".join(f"<li>{html.escape(note)}</li>" for note in table.notes)
        parts.append(f"<figcaption><ul>{notes}</ul></figcaption>\n")
    return "".join(parts) + "</figure>\n"


def to_html_page(table: Table) -> str:
    """The table as a page of its own, in the style of reports."""
    style = files("gsbench.analysis.report").joinpath("style.css").read_text(encoding="utf-8")
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{html.escape(table.title)}</title>\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<style>{style}</style></head>\n<body><main>\n{to_html(table)}</main></body></html>\n"
    )


FORMATS: dict[str, tuple[str, Callable[[Table], str]]] = {  # name -> file suffix, writer
    "md": ("md", to_markdown),
    "csv": ("csv", to_csv),
    "latex": ("tex", to_latex),
    "html": ("html", to_html_page),
}

WRAPPED_SHARE = 0.7  # of a line of LaTeX, for the columns of a table whose cells wrap

_LATEX = {
    "\\": "\\textbackslash{}", "&": "\\&", "%": "\\%", "$": "\\$", "#": "\\#", "_": "\\_", "{": "\\{", "}": "\\}",
    "~": "\\textasciitilde{}", "^": "\\textasciicircum{}", "<": "$<$", ">": "$>$", "|": "$|$",
    "±": "$\\pm$", "↑": "$\\uparrow$", "↓": "$\\downarrow$", "—": "---", "–": "--", "−": "$-$", "…": "\\ldots{}",
    "×": "$\\times$", "≈": "$\\approx$", "≠": "$\\neq$", "≤": "$\\leq$", "≥": "$\\geq$", "Δ": "$\\Delta$",
    "·": "$\\cdot$", "²": "$^2$", "“": "``", "”": "''", "‘": "`", "’": "'",
}  # fmt: skip
_LATEX_PATTERN = re.compile("|".join(re.escape(character) for character in _LATEX))


def escape_latex(text: str) -> str:
    """Text as LaTeX source; a character that plain LaTeX does not know becomes a question mark."""
    escaped = _LATEX_PATTERN.sub(lambda match: _LATEX[match[0]], text)
    return escaped.encode("latin-1", "replace").decode("latin-1")


def _column_groups(table: Table) -> list[tuple[str, int]]:
    """Neighbouring columns of one group, as (name, number of columns)."""
    return [
        (name, len(list(group))) for name, group in itertools.groupby(table.columns, key=lambda column: column.group)
    ]


def _flat_heading(column: Column) -> str:
    return f"{column.group} {column.heading}".strip()


def _markdown_row(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _pipe(text: str) -> str:
    return text.replace("|", "\\|")


def _latex_text(entry: Entry) -> str:
    text = escape_latex(entry.text)
    return f"\\textbf{{{text}}}" if entry.bold else text


def _html_text(entry: Entry) -> str:
    text = html.escape(entry.text)
    return f"<strong>{text}</strong>" if entry.bold else text


def _numbers(entry: Entry) -> list[object]:
    cell = entry.cell
    return [None] * 4 if cell is None else [cell.mean, cell.std, cell.count, cell.expected]


def _trials(entry: Entry) -> str:
    return " ".join(trial.label for trial in entry.cell.trials) if entry.cell else ""
