"""The page of simulations, findings/simulations.md: the scripts that simulate write its tables."""

from __future__ import annotations

import re
from pathlib import Path

PAGE = Path(__file__).resolve().parents[1] / "findings" / "simulations.md"


def table(name: str) -> str:
    """The lines between ``<!-- name -->`` and ``<!-- end -->``; raises ValueError if it has none."""
    found = _pattern(name).search(PAGE.read_text(encoding="utf-8"))
    if found is None:
        raise ValueError(f"{PAGE.name} has no table {name!r}: put <!-- {name} --> and <!-- end -->")
    return found[2]


def write_table(name: str, text: str) -> None:
    """Put ``text`` in the place of a table."""
    old = table(name)
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(
        page.replace(f"<!-- {name} -->\n{old}", f"<!-- {name} -->\n{text}"), encoding="utf-8"
    )


def _pattern(name: str) -> re.Pattern[str]:
    return re.compile(rf"(<!-- {name} -->\n)(.*?)(<!-- end -->)", re.DOTALL)
