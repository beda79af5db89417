"""A trial's folder: where it lies, in which state it is, and all that is read from or written to its files.

Nothing here follows a link (`gsbench.files.open_plain`): a runs folder may be somebody else's. Loads no torch.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
import re
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from pydantic_core import to_json

from gsbench.errors import InputError
from gsbench.files import atomic, require_no_links
from gsbench.parsing import DamagedError, one_line, read_bytes, read_tail, read_yaml
from gsbench.records import MAX_NUMBER, Amount, Count, Record, read_if_sound, read_typed, typed
from gsbench.runs.keys import config_hash
from gsbench.runs.layout import (
    BUILDING,
    CONFIG,
    CURVES,
    EVENTS,
    FAILED,
    HISTOGRAMS,
    LOCK,
    PER_VIEW,
    RESULTS,
    SEED,
)
from gsbench.runs.made_of import MADE_OF, READ_LATER, MadeOf, OnDisk, changes, content_hash, describe_inputs
from gsbench.runs.trial_record import Histogram, Row, TrialRecord, UnfinishedError, read_rows, record_from
from gsbench.settings import FolderName
from gsbench.system.locks import is_held

State = Literal["done", "running", "failed", "partial", "damaged", "missing"]
Rows = list[dict[str, bool | int | float]]

TAIL_BYTES = 4096


@dataclass(frozen=True, kw_only=True)
class NamedGroup(Record):
    """A group of the configuration, of which only the name must be there."""

    name: FolderName


@dataclass(frozen=True, kw_only=True)
class TrackingSettings(Record):
    """Settings of the group ``tracking`` that mirroring a trial later needs."""

    uri: str | None
    flush_seconds: Amount
    patience_seconds: Amount
    images: Count


@dataclass(frozen=True, kw_only=True)
class Configuration(Record):
    """Keys that a trial's ``config.yaml`` must have to be used at all; `gsbench.config.schema` has the rest."""

    name: FolderName
    seed: Count
    runs: str
    scene: NamedGroup
    init: NamedGroup
    densify: NamedGroup
    tracking: TrackingSettings


@dataclass(frozen=True, kw_only=True)
class Failure(Record):
    """``failed.json``: the kind of the error, its text, where it came from, and when (Unix time)."""

    error: str = ""
    message: str = ""
    traceback: str = field(default="", repr=False)
    time: Amount = 0.0
    seed: Count = 0
    bad_input: bool = False  # the user's files or settings are the cause

    @property
    def reason(self) -> str:
        """The first line of the text."""
        lines = (self.message or self.error).strip().splitlines()
        return one_line(lines[0]) if lines else "no reason was given"


@dataclass(frozen=True, kw_only=True)
class Building(Record):
    """``building.json``: the stage that an unfinished trial is at, and the folder where it is built."""

    stage: str = ""
    folder: str = ""


class TrialFolder:
    """The folder ``<runs>/<experiment>/<scene>/<init>-<densify>/<hash8>-seed<k>`` of a trial, and its files.

    Examples:
        >>> TrialFolder(Path("runs/table1/garden/sfm-adc/3fa9c1d2-seed0")).label
        'garden/sfm-adc seed 0 (3fa9c1d2)'
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._digests: Mapping[str, str] | None = None  # of the results that were read last

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> TrialFolder:
        """The folder of the trial with the resolved configuration ``values``."""
        runs = Path(values["runs"]).expanduser().resolve()
        arm = f"{values['init']['name']}-{values['densify']['name']}"
        leaf = f"{config_hash(dict(values))[:8]}{SEED}{values['seed']}"
        return cls(runs / values["name"] / values["scene"]["name"] / arm / leaf)

    @property
    def runs(self) -> Path:
        """The runs folder."""
        return self.path.parents[3]

    @property
    def home(self) -> Path:
        """The experiment's folder."""
        return self.path.parents[2]

    @property
    def key(self) -> str:
        """The folder within its experiment, without the seed (`gsbench.runs.declaration.trial_key`)."""
        return self.path.relative_to(self.home).as_posix().rpartition(SEED)[0]

    @property
    def lock(self) -> Path:
        """The lock that the process which runs the trial holds."""
        return self.path / LOCK

    @property
    def label(self) -> str:
        """Scene, arm and seed, for people."""
        hash8, _, seed = self.path.name.partition(SEED)
        return f"{self.path.parent.parent.name}/{self.path.parent.name} seed {seed} ({hash8})"

    def require_no_links(self) -> None:
        """Raise InputError where the folder, what is above it, or anything below it is a link, a pipe or a device."""
        require_no_links(self.runs, self.path, below=True)

    # ---- state

    def state(self) -> State:
        """The state of the trial, from its folder alone."""
        if is_held(self.lock):
            return "running"
        try:
            self.record()
            return "done"
        except FileNotFoundError:
            pass
        except DamagedError:
            return "damaged"
        if (self.path / FAILED).exists():
            return "failed"
        return "partial" if (self.path / CONFIG).exists() else "missing"

    def failure(self) -> Failure:
        """The reason why the trial failed."""
        return read_if_sound(self.path / FAILED, Failure) or Failure(message=f"{FAILED} cannot be read")

    def has_failed(self) -> bool:
        """Return whether the trial's last run failed."""
        return (self.path / FAILED).exists()

    def building(self) -> Building:
        """The stage that the trial is at; an empty one where it is at none, or that cannot be read."""
        return read_if_sound(self.path / BUILDING, Building) or Building()

    def stage_and_step(self) -> tuple[str, int]:
        """The stage that the unfinished trial is at ("" if none has begun), and the last iteration that it logged."""
        building = self.building()
        try:
            tail = read_tail(Path(building.folder, CURVES), TAIL_BYTES) if building.folder else b""
        except (FileNotFoundError, DamagedError):
            tail = b""
        steps = re.findall(rb'"step": (\d{1,18})', tail)
        return building.stage, int(steps[-1]) if steps else 0

    # ---- configuration

    def configuration(self) -> dict[str, Any]:
        """The configuration that the trial wrote, which allows nothing to run; raises InputError where unreadable."""
        path = self.path / CONFIG
        try:
            values = read_yaml(path)
        except FileNotFoundError:
            raise InputError(f"{path} is not there: give the command of the trial again") from None
        typed(to_json(values), Configuration, path)
        return values | {"allow_targets": []}  # permission comes from the one who types

    # ---- results

    def record(self) -> TrialRecord:
        """The content of ``results.json``.

        Raises FileNotFoundError where there is none, and DamagedError where it is damaged, unfinished, or not as it was
        written. Results that do not say what they were made of cannot be checked, and are believed.
        """
        path = self.path / RESULTS
        content = read_bytes(path)
        record = record_from(content, path)
        made_of = typed(content, OnDisk, path).made_of
        if made_of is not None and made_of.results != content_hash(content):
            raise DamagedError(path, f"was changed after it was written: `gsbench retry {self.home.name}` repairs it")
        self._digests = {} if made_of is None else made_of.digests
        return record

    def sound_record(self) -> TrialRecord | None:
        """The same as `record`, but None where the trial has no results that can be relied on."""
        try:
            return self.record()
        except (FileNotFoundError, DamagedError):
            return None

    def made_of(self) -> MadeOf | None:
        """The inputs of the results; None where they do not say. Raises as `record`, but checks nothing."""
        return read_typed(self.path / RESULTS, OnDisk).made_of

    def settings(self) -> dict[str, Any]:
        """The settings that the results were made by, else those of ``config.yaml``.

        Those in ``results.json`` are some twenty times quicker to read than YAML. Raises FileNotFoundError and
        DamagedError.
        """
        try:
            made_of = self.made_of()
        except FileNotFoundError:
            made_of = None
        return read_yaml(self.path / CONFIG) if made_of is None else made_of.settings

    def write_finished(
        self,
        values: Mapping[str, Any],
        record: TrialRecord,
        sources: Iterable[Path] = (),
        entries: Mapping[str, Path] | None = None,
        published: Iterable[Path] = (),
    ) -> bool:
        """Write ``results.json``, after which the trial is complete.

        ``sources`` are the user's files, ``entries`` results of stages by name, ``published`` the files that the folder
        shows. True where equal results stood there already: what they were made of is written anew, and the file keeps
        its time.
        """
        path, content = self.path / RESULTS, record.to_json()
        known = self.sound_record()
        before = path.stat() if known is not None and known.to_json() == content else None
        shown = sorted({*published, *(self.path / name for name in READ_LATER if (self.path / name).is_file())})
        made_of = describe_inputs(self.path, values, content, sources, entries or {}, shown)
        with atomic(path) as temporary:
            temporary.write_text(json.dumps(content | {MADE_OF: made_of.to_json()}, indent=1, allow_nan=False) + "\n")
            if before is not None:  # a verdict counts results that were there before it was declared
                os.utime(temporary, ns=(before.st_atime_ns, before.st_mtime_ns))
        return before is not None

    def why_not_done(
        self,
        values: dict[str, Any],
        unavailable_now: Callable[[dict[str, Any]], Collection[str]] = lambda options: (),
    ) -> str:
        """The reason to run or check the trial with the resolved configuration ``values``; "" where it is done.

        It is done where nothing that it was made of has changed. A trial that lacks a metric for want of weights is
        done only if ``unavailable_now``, called with the ``eval`` settings, says that it would lack it again.
        """
        try:
            record, made_of = self.record(), self.made_of()
        except (FileNotFoundError, UnfinishedError):
            return f"{RESULTS} is not there, or not complete"
        except DamagedError as error:
            return f"{error.path.name} {error.reason}"
        if made_of is None:
            return f"{RESULTS} does not say what it was made of"
        return next(changes(self.path, values, record, made_of), "") or _lacking(
            record, unavailable_now, values["eval"]
        )

    # ---- files beside the results

    def curves(self) -> Rows:
        """The rows of ``metrics.jsonl``, each with an integer ``step``; [] where there is none.

        A file of a finished trial that is not as it was written is left out, as is what follows a damaged row, with a
        warning.
        """
        return self.rows(CURVES)

    def events(self) -> Rows:
        """The rows of ``events.jsonl``: what every refinement did; as `curves`."""
        return self.rows(EVENTS)

    def histograms(self) -> list[Histogram]:
        """The rows of ``volume_histograms.jsonl``; as `curves`."""
        return self.rows(HISTOGRAMS, Histogram)

    def rows(self, name: str, kind: Any = Row) -> list[Any]:
        """The rows of a file of JSON lines; see `gsbench.runs.trial_record`."""
        return read_rows(self.path / name, kind, lambda path: self._unchanged(path.name))

    def views(self) -> dict[str, dict[str, float]]:
        """The metrics of every test view, ``{view: {metric: value}}``, from ``per_view.csv``.

        Raises FileNotFoundError and DamagedError.
        """
        path, content = self.path / PER_VIEW, self._unchanged(PER_VIEW)
        try:
            text = content.decode("utf-8")
            return {
                row["view"]: {key: _number(value) for key, value in row.items() if key != "view" and value != ""}
                for row in csv.DictReader(io.StringIO(text, newline=""))
            }
        except (UnicodeDecodeError, KeyError, TypeError, ValueError, csv.Error) as error:
            raise DamagedError(path, f"is damaged ({one_line(repr(error))})") from None

    def pictures(self, kind: str) -> list[Path]:
        """The pictures of a kind (``renders``, ``ground_truth``, ``figures``), sorted by name."""
        return sorted((self.path / kind).glob("*.png"))

    def _unchanged(self, name: str) -> bytes:
        """The content of a file; raises as `read_bytes`, and DamagedError where it is not as it was written."""
        content = read_bytes(self.path / name)
        if self._digests is None:
            self.sound_record()
        wanted = (self._digests or {}).get(name)
        if wanted is not None and hashlib.sha256(content).hexdigest() != wanted:
            raise DamagedError(
                self.path / name, "was changed after it was written: delete it, and `gsbench retry` repairs the trial"
            )
        return content


def _lacking(
    record: TrialRecord, unavailable_now: Callable[[dict[str, Any]], Collection[str]], options: dict[str, Any]
) -> str:
    """The metrics that a trial lacks and that could be computed now, in words; "" where there are none."""
    awaited = set(record.awaited)  # those that may still come, once their weights or packages are there
    missing = sorted(awaited - set(unavailable_now(options))) if awaited else []
    return f"it lacks {', '.join(missing)}, which can be computed now" if missing else ""


def _number(text: str) -> float:
    value = float(text)
    if not abs(value) <= MAX_NUMBER:
        raise ValueError(f"{text} is not a measured number")
    return value
