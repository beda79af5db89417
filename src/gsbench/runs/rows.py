"""The JSON lines of a training: metrics, events and histograms of volumes, by iteration."""

import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import AfterValidator, Field

from gsbench.parsing import (
    Amount,
    Count,
    DamagedError,
    Number,
    Record,
    Whole,
    parse_typed,
    read_bytes,
)

log = logging.getLogger(__name__)
T = TypeVar("T")

STEP = "step"  # the key of the iteration in every row
Exponent = Annotated[float, Field(ge=-300, le=300)]  # ten to this power is a finite number above 0


def _with_step(row: dict[str, bool | int | float]) -> dict[str, bool | int | float]:
    step = row.get(STEP)
    if not isinstance(step, int) or isinstance(step, bool) or step < 0:
        raise ValueError(f"{STEP} is not an iteration")
    return row


Value = bool | Whole | Number
# a row of ``metrics.jsonl`` or ``events.jsonl``
Row = Annotated[dict[str, Value], AfterValidator(_with_step)]


class RowWithStep(Record):
    """A row of any of these files; only its iteration is checked."""

    step: Count


class Histogram(RowWithStep):
    """A row of ``volume_histograms.jsonl``: counts between edges, which are log10 of volumes."""

    log10_edges: list[Exponent]
    counts: list[Amount]

    def __post_init__(self) -> None:
        if len(self.log10_edges) != len(self.counts) + 1:
            raise ValueError("the edges are not one more than the counts")


def read_rows(path: Path, kind: Any = Row, read: Callable[[Path], bytes] = read_bytes) -> list[Any]:
    """The rows of a file, each of type ``kind``; [] if there is no such file.

    ``read`` reads the content. With a warning, a file that cannot be read is left out, and so are
    all rows from a damaged one on.
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
    """The lines of a file such as ``metrics.jsonl`` up to the first damaged one, by iteration."""
    try:
        content = read_bytes(path)
    except FileNotFoundError:
        return []
    return [(line, row.step) for line, row in iterate_rows(content, RowWithStep, path)]


def iterate_rows(content: bytes, kind: type[T], path: Path) -> Iterator[tuple[str, T]]:
    """Parse the JSON lines of the file ``path``; yields each line with its object of ``kind``.

    A damaged line and the lines after it are left out. There is a warning, except for an incomplete
    last line, which a killed process leaves.
    """
    lines = content.splitlines(keepends=True)
    for number, line in enumerate(lines, 1):
        try:
            row = parse_typed(line, kind, path)
        except DamagedError as error:
            if line.endswith(b"\n") or number < len(lines):
                log.warning("left out: %s from line %d on, which %s", path, number, error.reason)
            return
        yield line.decode("utf-8").rstrip("\r\n"), row
