"""A page with one chart and some sentences: a single HTML file that needs no other."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from importlib.resources import files
from pathlib import Path

from gsbench.files import place_of, write_text


def write_page(out: Path, title: str, chart: str, lines: Sequence[str]) -> None:
    """Write the page to the file ``out``; ``chart`` is SVG. Raises InputError where it cannot be written."""
    style = files("gsbench.analysis.report").joinpath("style.css").read_text(encoding="utf-8")
    listed = "".join(f"<li>{escape(line)}</li>" for line in lines)
    page = (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f'<link rel="icon" href="data:,"><style>{style}</style></head>\n'
        f'<body><main><h1>{escape(title)}</h1><div class="charts">{chart}</div><ul>{listed}</ul></main></body></html>\n'
    )
    with place_of(out):
        write_text(out, page)
