"""The JSON-lines files of a training: what a row may hold, and reading them."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any

from pydantic import AfterValidator, Field

from gsbench.parsing import DamagedError, read_bytes
from gsbench.records import Amount, Count, Number, Part, Whole, iterate_rows
from gsbench.runs.inputs import read_unchanged

log = logging.getLogger(__name__)

STEP = "step"  # the key of every row: the iteration
NO_DIGESTS: Mapping[str, str] = MappingProxyType({})
Exponent = Annotated[float, Field(ge=-300, le=300)]  # ten to this power is a number


def _with_step(row: dict[str, bool | int | float]) -> dict[str, bool | int | float]:
    step = row.get(STEP)
    if not isinstance(step, int) or isinstance(step, bool) or step < 0:
        raise ValueError(f"{STEP} is no iteration")
    return row


Value = bool | Whole | Number
Row = Annotated[dict[str, Value], AfterValidator(_with_step)]  # of ``metrics.jsonl`` and ``events.jsonl``


@dataclass(frozen=True, kw_only=True)
class Stepped(Part):
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


def read_curve(path: Path, digests: Mapping[str, str] = NO_DIGESTS) -> list[dict[str, bool | int | float]]:
    """The rows of ``metrics.jsonl`` or ``events.jsonl``, each with an integer ``step``; [] where there is none.

    ``digests`` are those of a finished trial (`gsbench.runs.inputs`). A file that is not as it was written is left out,
    as is what follows a damaged row, with a warning.
    """
    return _read(path, digests, Row)


def read_histograms(path: Path, digests: Mapping[str, str] = NO_DIGESTS) -> list[Histogram]:
    """The rows of ``volume_histograms.jsonl``, as `read_curve` reads them."""
    return _read(path, digests, Histogram)


def whole_lines(path: Path) -> list[tuple[str, int]]:
    """The lines of ``metrics.jsonl`` or its like up to the first damaged one, each with its iteration."""
    try:
        content = read_bytes(path)
    except FileNotFoundError:
        return []
    return [(line, row.step) for line, row in iterate_rows(content, Stepped, path)]


def _read(path: Path, digests: Mapping[str, str], kind: Any) -> list[Any]:
    try:
        content = read_unchanged(path, digests)
    except FileNotFoundError:
        return []
    except DamagedError as error:
        log.warning("left out: %s", error)
        return []
    return [row for _, row in iterate_rows(content, kind, path)]
