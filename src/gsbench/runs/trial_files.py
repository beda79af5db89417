"""The small files of a trial's folder and the JSON lines of a training, to write and to read."""

import logging
from collections.abc import Callable, Iterator
from dataclasses import field
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import AfterValidator, Field

from gsbench.parsing import (
    Amount,
    Count,
    DamagedError,
    Number,
    Raw,
    Record,
    Whole,
    fault_of,
    one_line,
    parse_typed,
    read_bytes,
)
from gsbench.settings import FolderName
from gsbench.words import as_line

Stamp = tuple[int, ...]  # size in bytes, times of change in ns


class NamedGroup(Record):
    """A group of the configuration that must have a name."""

    name: FolderName


class TrackingSettings(Record):
    """The settings of the group ``tracking`` that later mirroring of a trial needs."""

    uri: str | None
    flush_seconds: Amount
    patience_seconds: Amount
    images: Count


class Configuration(Record):
    """The keys that every usable ``config.yaml`` has; `gsbench.config.schema` checks the others."""

    name: FolderName
    seed: Count
    runs: str
    scene: NamedGroup
    init: NamedGroup
    densify: NamedGroup
    tracking: TrackingSettings


class Failure(Record):
    """``failed.json``: the error's type, its text, its traceback, and the Unix time."""

    error: str = ""
    message: Raw = ""  # of several lines; `reason` is the first
    traceback: Raw = field(default="", repr=False)
    time: Amount = 0.0
    seed: Count = 0
    bad_input: bool = False  # the user's files or settings are the cause

    @property
    def reason(self) -> str:
        """The first line of the message."""
        lines = (self.message or self.error).strip().splitlines()
        return one_line(as_line(lines[0])) if lines else "no reason was given"


class Building(Record):
    """``building.json``: the present stage of an unfinished trial, and where it is built."""

    stage: str = ""
    folder: Raw = ""


class MadeOf(Record):
    """The inputs of a trial's results: configuration, versions, and files with their stamps.

    ``settings`` is the configuration, ``config`` its hash, ``results`` the hash of the rest of
    ``results.json``. ``sources`` are the user's files, ``folders`` their folders with times of
    change. ``entries`` are the stages' results in the store. ``published`` are files in the
    trial's folder; ``digests`` has the sha256 of those that tables and reports read, and of
    small ones. ``finished`` is the Unix time at which the trial first had these results; 0 if
    unknown.
    """

    results: str
    config: str
    stages: dict[str, int]
    pycolmap: str | None
    sources: dict[Raw, Stamp]
    folders: dict[Raw, int | None]
    entries: dict[str, Raw]
    published: dict[Raw, Stamp]
    digests: dict[Raw, str]
    settings: dict[str, Any]
    finished: Amount = 0.0

    def __post_init__(self) -> None:
        if fault := fault_of(self.settings):
            raise ValueError(f"in settings {fault}")


class ResultsFile(Record):
    """The part of ``results.json`` that this module reads."""

    made_of: MadeOf | None = field(default=None, repr=False)


class AskedBefore(Record):
    """The ids of the questions that covered a trial when the ``training`` (a key) began."""

    training: str
    questions: list[str]


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
