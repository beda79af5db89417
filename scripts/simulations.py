"""The page of simulations, findings/simulations.md: the scripts that simulate write its tables."""

from __future__ import annotations

from pathlib import Path

PAGE = Path(__file__).resolve().parents[1] / "findings" / "simulations.md"
END = "<!-- end -->"


def table(name: str) -> str:
    """The lines between ``<!-- name -->`` and the next end; raises ValueError without them."""
    return _parts(name)[1]


def write_table(name: str, text: str) -> None:
    """Put ``text`` in the place of a table."""
    before, _, after = _parts(name)
    PAGE.write_text(before + text + after, encoding="utf-8")


def _parts(name: str) -> tuple[str, str, str]:
    """The page before a table, the table, and the page after it."""
    begin, page = f"<!-- {name} -->\n", PAGE.read_text(encoding="utf-8")
    start = page.index(begin) + len(begin)
    end = page.index(END, start)
    return page[:start], page[start:end], page[end:]
