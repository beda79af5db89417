"""The JSON-lines files of a training: what a row may hold."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, Field

from gsbench.parsing import DamagedError, read_bytes
from gsbench.records import Amount, Count, Number, Record, Whole, iterate_rows

log = logging.getLogger(__name__)

STEP = "step"  # the key of every row: the iteration
Exponent = Annotated[float, Field(ge=-300, le=300)]  # ten to this power is a number


def _with_step(row: dict[str, bool | int | float]) -> dict[str, bool | int | float]:
    step = row.get(STEP)
    if not isinstance(step, int) or isinstance(step, bool) or step < 0:
        raise ValueError(f"{STEP} is not an iteration")
    return row


Value = bool | Whole | Number
Row = Annotated[dict[str, Value], AfterValidator(_with_step)]  # of ``metrics.jsonl`` and ``events.jsonl``


@dataclass(frozen=True, kw_only=True)
class Stepped(Record):
    """A row of any of these files, of which the iteration is asked for."""

    step: Count


@dataclass(frozen=True, kw_only=True)
class Histogram(Stepped):
    """A row of ``volume_histograms.jsonl``: counts between edges, the logarithms to the base 10 of volumes."""

    log10_edges: list[Exponent]
    counts: list[Amount]

    def __post_init__(self) -> None:
        if len(self.log10_edges) != len(self.counts) + 1:
            raise ValueError("the edges are not one more than the counts")


def read_rows(path: Path, kind: Any = Row, read: Callable[[Path], bytes] = read_bytes) -> list[Any]:
    """The rows of a file, each of type ``kind``; [] where there is none.

    ``read`` gives the content. What cannot be read, and what follows a damaged row, is left out, with a warning.
    """
    try:
        content = read(path)
    except FileNotFoundError:
        return []
    except DamagedError as error:
        log.warning("left out: %s", error)
        return []
    return [row for _, row in iterate_rows(content, kind, path)]


def whole_lines(path: Path) -> list[tuple[str, int]]:
    """The lines of ``metrics.jsonl`` or its like up to the first damaged one, each with its iteration."""
    try:
        content = read_bytes(path)
    except FileNotFoundError:
        return []
    return [(line, row.step) for line, row in iterate_rows(content, Stepped, path)]
