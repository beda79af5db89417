"""A ledger of ideas as tables, for the terminal and the report."""

import math

from gsbench.analysis.fairness import EQUAL_COUNTS
from gsbench.analysis.table_formats import Column, Row, Table, TableEntry
from gsbench.runs.experiments import display_time
from gsbench.runs.ledger import Confirmed, Confirming, Difference, Ended, Ledger, Opened
from gsbench.words import least_text, signed

HEADS = ("against", "level", "seeds", "difference", "Gaussians", "time", "result", "why")


def describe_ledger(ledger: Ledger) -> list[str]:
    """Two lines: what decides, and how many of the planned ideas were tried and kept."""
    opened = ledger.opened
    least = least_text(opened.least, opened.relative)
    better = "more" if opened.sign > 0 else "less"
    return [
        f"{opened.metric} decides: {better} is better, and {least} is the least that matters. "
        f"At most {100 * opened.rate:g} % of the kept ideas are expected to be no better.",
        f"{ledger.tried} of {opened.ideas} planned ideas were tried, and {len(ledger.kept)} kept, "
        f"on {', '.join(opened.keys)}, with at most {len(opened.seeds)} seeds"
        f"{'' if ledger.shares_seeds else ', and as many new ones for what looks better'}.",
    ]


def ledger_tables(ledger: Ledger) -> list[Table]:
    """The table of ideas, and one for each confirmation."""
    rows = []
    for number, (idea, started) in enumerate(ledger.started.items(), 1):
        ended = ledger.ended.get(idea)
        known = ("", "", "", "", "in its test" if idea in ledger.tests else "begun", "")
        if ended is not None:
            known = (
                f"{ended.seeds} new" if idea in ledger.tests else str(ended.seeds),
                difference_text(ledger.opened, ended.difference),
                _times(ended.gaussians),
                _times(ended.seconds),
                ended.result,
                why(ended),
            )
        test = ledger.tests.get(idea)
        level = started.level if test is None else test.level
        cells = (started.against, "" if level is None else f"{level:.2g}", *known)
        rows.append(Row((f"{number} {idea}",), tuple(map(TableEntry, cells))))
    columns = tuple(Column("", head, ("ledger", head)) for head in HEADS)
    notes = (LEVEL,) if ledger.shares_seeds else (LEVEL, UNTESTED)
    title = "Ideas in their order"
    tables = [Table(title, ("idea",), columns, tuple(rows), notes)]
    return tables + [
        _confirmation_table(ledger.opened, *confirmation) for confirmation in ledger.confirmations
    ]


LEVEL = (
    "level: the chance that this test keeps an idea that is no better. All levels follow from the "
    "share above; each kept idea raises those after it."
)
UNTESTED = (
    "Tests use new seeds. Ideas without a level did not look better on the seeds of all ideas, so "
    "they were not tested."
)


def why(ended: Ended) -> str:
    """The reason of a result; with unequal numbers of Gaussians it says so."""
    ratio = ended.gaussians
    if ratio is None or abs(ratio - 1) <= EQUAL_COUNTS:
        return ended.reason
    return f"{ended.reason}; with {ratio:.2f} times the Gaussians, so not at equal counts"


def _confirmation_table(opened: Opened, asked: Confirming, results: Confirmed | None) -> Table:
    """The gains of the kept ideas on captures that no idea has seen."""
    rows = []
    for idea in list(asked.keys)[1:]:
        cells = ("", "trials are missing")
        if results is not None:
            difference = difference_text(opened, results.differences.get(idea))
            cells = (difference, results.results[idea])
        rows.append(Row((idea,), tuple(map(TableEntry, cells))))
    scenes = ", ".join(next(iter(asked.keys.values())))
    title = f"Confirmation on {scenes} with {len(asked.seeds)} seeds ({display_time(asked.time)})"
    heads = ("difference from the baseline", "result")
    columns = tuple(Column("", head, ("confirmation", head)) for head in heads)
    return Table(title, ("idea",), columns, tuple(rows))


def difference_text(opened: Opened, difference: Difference | None) -> str:
    """``+0.0123 (+0.0040 to +0.0210)``, or in % for a relative question; "" without a test."""
    if difference is None:
        return ""
    values = (difference.mean, difference.low, difference.high)
    if opened.relative:
        mean, low, high = (f"{signed(100 * math.expm1(value), '.1f')} %" for value in values)
    else:
        mean, low, high = (signed(value, ".4g") for value in values)
    return f"{mean} ({low} to {high})"


def _times(ratio: float | None) -> str:
    return "" if ratio is None else f"×{ratio:.2f}"
