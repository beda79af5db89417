"""The small files of a trial's folder, for writing and for reading."""

from dataclasses import field
from typing import Any

from gsbench.parsing import Amount, Count, Raw, Record, fault_of, one_line
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
