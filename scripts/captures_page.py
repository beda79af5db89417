"""Write the table of rules (`gsbench.scene.rules`) into docs/captures.md, between its two marks."""

import math
import textwrap
from pathlib import Path
from string import Formatter

from gsbench.scene.rules import ABOVE_ZERO, RULES, Rule

PAGE = Path(__file__).parents[1] / "docs" / "captures.md"
BEGIN, END = "<!-- rules: made by scripts/captures_page.py -->", "<!-- end of rules -->"
LONGEST = 80  # characters of a sentence


def limits(values: tuple[float, float]) -> str:
    """A range of values in words, to four digits."""
    low, high = (f"{round(value, 9):.4g}" for value in values)
    if values == ABOVE_ZERO:
        return "above 0"
    if math.isinf(values[0]):
        return "" if math.isinf(values[1]) else f"at most {high}"
    return f"at least {low}" if math.isinf(values[1]) else f"{low} to {high}"


def sentence(rule: Rule) -> str:
    """A rule's sentence, with an ellipsis for each fact."""
    parts = [text + ("…" if name else "") for text, name, *_ in Formatter().parse(rule.say)]
    return textwrap.shorten("".join(parts), LONGEST, placeholder=" …")


def table() -> str:
    rows = ["| rule | a line, unless | refused, unless | what it says |", "|---|---|---|---|"]
    for rule in RULES:
        refused = limits(rule.usable)
        if rule.fixed:
            refused += " (always)"
        rows.append(
            f"| `{rule.id}` | {limits(rule.fine)} | {refused or 'never'} | {sentence(rule)} |"
        )
    return "\n".join(rows).replace("at most 1 (always)", "below 1 (always)")


def page(text: str) -> str:
    """The page with the present table."""
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(END)
    return f"{before}{BEGIN}\n\n{table()}\n\n{END}{after}"


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text("utf-8")), "utf-8")
