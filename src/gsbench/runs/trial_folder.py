"""A trial's folder: its path, its state, reading and writing its files, and what it was made of.

Nothing here follows a link (`gsbench.files.open_plain`): the runs folder may come from a stranger.
This module loads no torch.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
import re
import time
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any, Literal

from gsbench.errors import InputError
from gsbench.files import atomic, require_no_links
from gsbench.parsing import (
    MAX_NUMBER,
    DamagedError,
    fault_of,
    one_line,
    parse_json,
    read_bytes,
    read_if_sound,
    read_tail,
    read_typed,
    read_yaml,
    typed,
)
from gsbench.runs import layout
from gsbench.runs.code import PERMISSIONS, config_hash
from gsbench.runs.commands import make_digest, remember_result, shared_hash
from gsbench.runs.configuration import Values, sha256_of
from gsbench.runs.freshness import (
    Change,
    MadeOf,
    ResultsFile,
    changed_files,
    changes,
    damaged_entries,
    origin_of,
)
from gsbench.runs.trial_record import (
    Building,
    Configuration,
    Failure,
    TrialRecord,
    UnfinishedError,
    read_rows,
    record_from,
)
from gsbench.system.locks import is_held
from gsbench.words import as_line, command

MADE_OF = "made_of"  # the key in results.json
State = Literal["done", "running", "failed", "partial", "damaged", "missing"]

TAIL_BYTES = 4096  # bytes at the end of a growing log, enough for its last rows


class TrialFolder:
    """The folder ``<runs>/<experiment>/<scene>/<init>-<densify>/<hash8>-seed<k>`` of a trial.

    Examples:
        >>> TrialFolder(Path("runs/table1/garden/sfm-adc/3fa9c1d2-seed0")).label
        'garden/sfm-adc seed 0 (3fa9c1d2)'
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._origin: MadeOf | None = None  # of the results that were read last, if recorded

    @classmethod
    def of(cls, values: Values) -> TrialFolder:
        """The folder of the trial with the resolved configuration ``values``."""
        runs = Path(values["runs"]).expanduser().resolve()
        arm = f"{values['init']['name']}-{values['densify']['name']}"
        leaf = f"{config_hash(values)[:8]}{layout.SEED}{values['seed']}"
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
        """The folder in its experiment, without the seed (``garden/sfm-adc/3fa9c1d2``)."""
        return self.path.relative_to(self.home).as_posix().rpartition(layout.SEED)[0]

    @property
    def lock(self) -> Path:
        """The lock file of the process that runs the trial."""
        return self.path / layout.LOCK

    @property
    def label(self) -> str:
        """Scene, arm, seed and hash, for messages."""
        hash8, _, seed = self.path.name.partition(layout.SEED)
        return f"{self.path.parent.parent.name}/{self.path.parent.name} seed {seed} ({hash8})"

    def require_no_links(self) -> None:
        """Raise InputError if the folder, one above it, or its content is a link or a device."""
        require_no_links(self.runs, self.path, below=True)

    # ---- state

    def state(self) -> State:
        """The state of the trial, from its folder alone."""
        if is_held(self.lock):
            return "running"
        try:
            self.record()
            return "damaged" if self.change() else "done"
        except FileNotFoundError:
            pass
        except DamagedError:
            return "damaged"
        if self.has_failed():
            return "failed"
        return "partial" if (self.path / layout.CONFIG).exists() else "missing"

    def failure(self) -> Failure:
        """The reason why the trial failed."""
        return read_if_sound(self.path / layout.FAILED, Failure) or Failure(
            message=f"{layout.FAILED} cannot be read"
        )

    def has_failed(self) -> bool:
        """Return whether the trial's last run failed."""
        return (self.path / layout.FAILED).exists()

    def building(self) -> Building:
        """The present stage of the trial; empty if it has none, or if the file cannot be read."""
        return read_if_sound(self.path / layout.BUILDING, Building) or Building()

    def stage_and_step(self) -> tuple[str, int]:
        """The present stage of an unfinished trial ("" before the first) and its last iteration."""
        building = self.building()
        try:
            tail = (
                read_tail(Path(building.folder, layout.CURVES), TAIL_BYTES)
                if building.folder
                else b""
            )
        except (FileNotFoundError, DamagedError):
            tail = b""
        steps = re.findall(rb'"step": (\d{1,18})', tail)
        return building.stage, int(steps[-1]) if steps else 0

    def share_done(self, iterations: int) -> float:
        """The share of a training's ``iterations`` that are done."""
        return min(1.0, self.stage_and_step()[1] / max(1, iterations))

    # ---- configuration

    def configuration(self) -> dict[str, Any]:
        """The configuration in ``config.yaml``, without its permissions.

        Raises InputError if it cannot be used.
        """
        path = self.path / layout.CONFIG
        try:
            values = read_yaml(path)
        except FileNotFoundError:
            raise InputError(f"{path} is not there: give the command of the trial again") from None
        typed(values, Configuration, path)
        # only the user who gives a command may allow code to run
        return values | {PERMISSIONS: []}

    # ---- results

    def record(self) -> TrialRecord:
        """The content of ``results.json``.

        Raises FileNotFoundError if there is none, and DamagedError if it is damaged, unfinished, or
        was changed after it was written. Results without ``made_of`` cannot be checked for changes,
        and are accepted.
        """
        path = self.path / layout.RESULTS
        values = parse_json(read_bytes(path), path)
        record, made_of = record_from(values, path), typed(values, ResultsFile, path).made_of
        if made_of is not None:
            del values[MADE_OF]
            # compared as values: white space does not matter
            if made_of.results != sha256_of(values):
                repair = command("retry", self.home.name)
                reason = f"was changed after it was written: `{repair}` repairs it"
                raise DamagedError(path, reason)
        self._origin = made_of
        return record

    def change(self, thorough: bool = False) -> Change | None:
        """A change among the judged files since the results were written (`changed_files`)."""
        origin = self._known_origin()
        found = changed_files(self.path, origin, thorough=thorough) if origin else ()
        return next(iter(found), None)

    def fault_when_read(self) -> Change | None:
        """A change in the files of a finished trial, or in its results in the store; None if none.

        All are read: `change` and `why_not_done` trust the size and time of large ones.
        """
        made = self.made_of()
        if made is None:
            return Change("unrecorded", layout.RESULTS)
        files = changed_files(self.path, made, made.digests, thorough=True)
        return next(chain(files, damaged_entries(made, thorough=True)), None)

    def _known_origin(self) -> MadeOf | None:
        """The origin of the results, read if it was not yet; None if unrecorded or unsound."""
        if self._origin is None:
            self.sound_record()
        return self._origin

    def sound_record(self) -> TrialRecord | None:
        """The same as `record`, but None if the trial has no sound results."""
        try:
            return self.record()
        except (FileNotFoundError, DamagedError):
            return None

    def made_of(self) -> MadeOf | None:
        """The inputs of the results, not checked for changes; None if they are not recorded.

        Raises FileNotFoundError and DamagedError.
        """
        return read_typed(self.path / layout.RESULTS, ResultsFile).made_of

    def settings(self) -> dict[str, Any]:
        """The settings in ``results.json``, else in ``config.yaml``, which takes 20 times longer.

        Raises FileNotFoundError and DamagedError.
        """
        with suppress(FileNotFoundError):
            if made_of := self.made_of():
                if fault := fault_of(made_of.settings):
                    reason = f"is damaged: in settings {fault}"
                    raise DamagedError(self.path / layout.RESULTS, reason)
                return made_of.settings
        return read_yaml(self.path / layout.CONFIG)

    def write_finished(
        self,
        values: Values,
        record: TrialRecord,
        sources: Iterable[Path] = (),
        entries: Mapping[str, Path] | None = None,
        published: Iterable[Path] = (),
    ) -> bool:
        """Write ``results.json``, after which the trial is complete.

        ``sources`` are the user's files, ``entries`` results of stages by name, ``published`` files
        in this folder. Returns True if it already had equal results: then only ``made_of`` is
        renewed, and the trial keeps its time.
        """
        path = self.path / layout.RESULTS
        # as it will be read: texts of libraries become one line
        content = record_from(record.to_json(), path).to_json()
        present = self.sound_record()
        before = path.stat() if present is not None and present.to_json() == content else None
        # Verdicts count results from before their declaration by this time, so equal results
        # must not look newer.
        finished = time.time()
        if before is not None:
            finished = (self._origin and self._origin.finished) or before.st_mtime
        origin = origin_of(self.path, content, values, sources, entries or {}, published)
        origin = replace(origin, finished=finished)
        config_hash = shared_hash(self.path.name.partition(layout.SEED)[0], values["densify"])
        code = record.code
        digest = make_digest(self.path.parent.name, config_hash, code.sources, code.packages)
        remember_result(self.home, self.path, digest)
        with atomic(path) as temporary:
            temporary.write_text(
                json.dumps(content | {MADE_OF: origin.to_json()}, indent=1, allow_nan=False) + "\n"
            )
            if before is not None:
                os.utime(temporary, ns=(before.st_atime_ns, before.st_mtime_ns))
        return before is not None

    def why_not_done(
        self,
        values: Values,
        unavailable_now: Callable[[dict[str, Any]], Collection[str]] | None = None,
    ) -> Change | None:
        """The reason to run or check the trial with the configuration ``values``; None if done.

        It is done if nothing that made it has changed. If it lacks a metric whose weights or
        packages were missing, it is done only if ``unavailable_now``, called with the
        ``eval`` settings, still contains that metric. Without ``unavailable_now``, it is
        not known whether the metric can be computed, so the trial must be checked.
        """
        try:
            record = self.record()
        except (FileNotFoundError, UnfinishedError):
            return Change("unfinished", layout.RESULTS)
        except DamagedError as error:
            return Change("damaged", error.path.name, now=error.reason)
        if (origin := self._origin) is None:
            return Change("unrecorded", layout.RESULTS)
        if change := next(changes(self.path, values, record, origin), None):
            return change
        if not record.awaited:  # asking loads torch
            return None
        if unavailable_now is None:
            return Change("lacking", ", ".join(record.awaited))
        available = sorted(set(record.awaited) - set(unavailable_now(values["eval"])))
        return Change("computable", ", ".join(available)) if available else None

    # ---- files beside the results

    def curves(self, name: str = layout.CURVES) -> list[Any]:
        """The rows of a file of JSON lines that a training wrote; [] without the file.

        With a warning, a finished trial's file that was changed after it was written is left out,
        and so are all rows from a damaged one on.
        """
        return read_rows(self.path / name, lambda path: self._unchanged(path.name))

    def views(self) -> dict[str, dict[str, float]]:
        """The metrics of every test view, ``{view: {metric: value}}``, from ``per_view.csv``.

        Raises FileNotFoundError and DamagedError.
        """
        path, content = self.path / layout.PER_VIEW, self._unchanged(layout.PER_VIEW)
        try:
            views = {}
            for row in csv.DictReader(io.StringIO(content.decode("utf-8"), newline="")):
                name = as_line(row.pop("view"))
                views[name] = {key: _number(value) for key, value in row.items() if value != ""}
            return views
        except (UnicodeDecodeError, KeyError, TypeError, ValueError, csv.Error) as error:
            raise DamagedError(path, f"is damaged ({one_line(repr(error))})") from None

    def pictures(self, kind: str) -> list[Path]:
        """The pictures of a kind (``renders``, ``ground_truth``), sorted by name."""
        return sorted((self.path / kind).glob("*.png"))

    def _unchanged(self, name: str) -> bytes:
        """The content of a file, as it was written.

        Raises FileNotFoundError, and DamagedError if it cannot be read or was changed
        later.
        """
        content = read_bytes(self.path / name)
        origin = self._known_origin()
        recorded = None if origin is None else origin.digests.get(name)
        if recorded is not None and hashlib.sha256(content).hexdigest() != recorded:
            raise DamagedError(
                self.path / name,
                "was changed after it was written: delete it, and `gsbench retry` repairs the "
                "trial",
            )
        return content


def _number(text: str) -> float:
    value = float(text)
    if not abs(value) <= MAX_NUMBER:
        raise ValueError(f"{text} is not a measured number")
    return value
