"""The ledger of many ideas, ``<runs>/<experiment>/ledger.jsonl``: what was tried, in which order.

The file grows by whole lines. Each line has the sha256 of the line before it and one of its own
content, so a line that was edited or moved is found when the file is read (`read_ledger`), also the
last one. Nothing here is secret: who writes all hashes anew can write another ledger.
"""

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from gsbench.errors import InputError
from gsbench.files import require_no_links, write_text
from gsbench.parsing import (
    Amount,
    Count,
    DamagedError,
    Number,
    Record,
    Text,
    parse_typed,
    read_bytes,
)
from gsbench.runs.layout import LEDGER
from gsbench.system.locks import hold

TrialKey = Annotated[str, Field(pattern=r"^[^/]*/[^/]*/[^/]*$")]

BASELINE = "baseline"  # the name of the ledger's own baseline among the ideas

Result = Literal["kept", "dropped", "undecided", "failed"]
KEPT: Result = "kept"
DROPPED: Result = "dropped"
UNDECIDED: Result = "undecided"
FAILED: Result = "failed"
Seeds = Annotated[tuple[Count, ...], Field(min_length=2)]
Level = Annotated[float, Field(gt=0, lt=1)]


class Opened(Record):
    """The first line: what decides, on which trials, and how many ideas share the error rate.

    ``least`` is the least difference in ``metric`` that matters, a fraction of the baseline's value
    if ``relative``. ``rate`` is the false discovery rate. ``words`` are the baseline's settings,
    ``keys`` its trials by scene.
    """

    kind: Literal["opened"] = "opened"
    time: Text
    metric: Text
    sign: Literal[-1, 1]
    least: Amount
    relative: bool = False
    ideas: Annotated[int, Field(ge=1, le=10_000)]
    rate: Annotated[float, Field(gt=0, lt=1)]
    seeds: Seeds
    words: tuple[str, ...]
    keys: dict[Text, TrialKey]


class Started(Record):
    """An idea, written before its first trial.

    ``against`` is the idea that it is compared with. ``identity`` is the hash of its settings and
    code without names: equal hashes are the same idea. ``level`` stands only in ledgers that are
    older than `Promoted`: the level of a test on the seeds of all ideas, which kept ideas then.
    """

    kind: Literal["started"] = "started"
    time: Text
    idea: Text
    against: Text
    level: Level | None = None
    identity: Text
    words: tuple[str, ...]
    keys: dict[Text, TrialKey]


class Promoted(Record):
    """An idea that looks better: the ``level`` of its test, and seeds that no idea has seen."""

    kind: Literal["promoted"] = "promoted"
    time: Text
    idea: Text
    level: Level
    seeds: Seeds


class Difference(Record):
    """A mean difference with its interval; for a relative question all three are logarithms."""

    mean: Number
    low: Number
    high: Number


class Ended(Record):
    """The result of an idea; "failed" if there is none, so that the idea may be tried again.

    ``gaussians`` and ``seconds`` are the ratios of its numbers of Gaussians and training times
    to those of what it was compared with.
    """

    kind: Literal["ended"] = "ended"
    time: Text
    idea: Text
    result: Result
    reason: str
    seeds: Count
    difference: Difference | None = None
    gaussians: Amount | None = None
    seconds: Amount | None = None


class Confirming(Record):
    """Captures and seeds that no idea has seen, chosen before their first trial.

    ``keys`` are the trials of the baseline and of each idea by scene.
    """

    kind: Literal["confirming"] = "confirming"
    time: Text
    seeds: Seeds
    keys: dict[Text, dict[Text, TrialKey]]


class Confirmed(Record):
    """The results of the confirmation ``number`` (from 0): each idea's difference."""

    kind: Literal["confirmed"] = "confirmed"
    time: Text
    number: Count
    results: dict[Text, Result]
    differences: dict[Text, Difference]


Entry = Opened | Started | Promoted | Ended | Confirming | Confirmed


class Line(Record):
    """An entry with the sha256 of the line before it, "" for the first, and its own."""

    before: str
    own: str
    entry: Annotated[Entry, Field(discriminator="kind")]


@dataclass(frozen=True)
class Ledger:
    """The entries of a ledger; the first one is `Opened`."""

    entries: tuple[Entry, ...]
    head: str = field(repr=False)  # sha256 of the last line

    @property
    def opened(self) -> Opened:
        first = self.entries[0]
        assert isinstance(first, Opened)  # `read_ledger` has checked it
        return first

    @cached_property
    def started(self) -> dict[str, Started]:
        """The ideas in the order in which they were begun."""
        return {entry.idea: entry for entry in self.entries if isinstance(entry, Started)}

    @cached_property
    def tests(self) -> dict[str, Promoted]:
        """The tests on seeds that no idea had seen, in their order."""
        return {entry.idea: entry for entry in self.entries if isinstance(entry, Promoted)}

    @cached_property
    def ended(self) -> dict[str, Ended]:
        return {entry.idea: entry for entry in self.entries if isinstance(entry, Ended)}

    @property
    def tried(self) -> int:
        """The number of ideas that count; those that failed do not, since they tell nothing."""
        failed = sum(entry.result == FAILED for entry in self.ended.values())
        return len(self.started) - failed

    @property
    def shares_seeds(self) -> bool:
        """Return whether it is older than `Promoted`, so that all its tests share their seeds."""
        return any(started.level is not None for started in self.started.values())

    def is_decided(self, idea: str) -> bool:
        """Return whether the idea has a result; it has none if its trials failed."""
        ended = self.ended.get(idea)
        return ended is not None and ended.result != FAILED

    def has_seen(self, seeds: Iterable[int]) -> bool:
        """Return whether any idea has trials with one of these seeds, or will have."""
        seen = [self.opened.seeds, *(test.seeds for test in self.tests.values())]
        return not set(seeds).isdisjoint(chain.from_iterable(seen))

    @property
    def kept(self) -> list[str]:
        """The ideas that were kept."""
        return [entry.idea for entry in self.ended.values() if entry.result == KEPT]

    @property
    def confirmations(self) -> list[tuple[Confirming, Confirmed | None]]:
        """Each confirmation with its results, None while trials are missing."""
        begun = [entry for entry in self.entries if isinstance(entry, Confirming)]
        done = {entry.number: entry for entry in self.entries if isinstance(entry, Confirmed)}
        return [(entry, done.get(number)) for number, entry in enumerate(begun)]

    def number_of(self, asked: Confirming) -> int | None:
        """The number of the confirmation with the same trials, None if there is none."""
        same = (asked.keys, asked.seeds)
        begun = [(entry.keys, entry.seeds) for entry, _ in self.confirmations]
        return begun.index(same) if same in begun else None

    def words_of(self, idea: str) -> tuple[str, ...]:
        """The settings of an idea, or of the baseline."""
        return self.opened.words if idea == BASELINE else self.started[idea].words

    def keys_of(self, idea: str) -> dict[str, str]:
        """The trials of an idea, or of the baseline, by scene."""
        return self.opened.keys if idea == BASELINE else self.started[idea].keys

    def all_keys(self) -> set[str]:
        """The keys of all trials that the ledger knows."""
        keys = set(self.opened.keys.values())
        for started in self.started.values():
            keys |= set(started.keys.values())
        for confirming, _ in self.confirmations:
            keys |= {key for own in confirming.keys.values() for key in own.values()}
        return keys


def read_ledger(home: Path) -> Ledger:
    """The ledger of the experiment in ``home``.

    Raises InputError, one line, if there is none, or if a line is damaged, edited, moved or
    missing.
    """
    path = home / LEDGER
    try:
        lines = _whole(read_bytes(path)).splitlines(keepends=True)
    except FileNotFoundError:
        raise InputError(
            f"{home.name} has no ledger: gsbench ledger new {home.name} --metric … begins one"
        ) from None
    head, entries = "", list[Entry]()
    for number, content in enumerate(lines, 1):
        try:
            line = parse_typed(content, Line, path)
        except DamagedError as error:
            raise InputError(f"{path}: line {number} {error.reason}: {MEND}") from None
        if line.before != head or isinstance(line.entry, Opened) != (number == 1):
            raise InputError(
                f"{path}: line {number} does not follow the line before it: one of them was "
                f"edited, moved or taken out: {MEND}"
            )
        if content.decode() != _line(head, as_json(line.entry)):
            raise InputError(f"{path}: line {number} was edited: {MEND}")
        if fault := _fault(Ledger(tuple(entries), head), line.entry):
            raise InputError(f"{path}: line {number} {fault}: {MEND}")
        entries.append(line.entry)
        head = hashlib.sha256(content).hexdigest()
    if not entries:
        raise InputError(f"{path} is empty: {MEND}")
    return Ledger(tuple(entries), head)


def _fault(before: Ledger, entry: Entry) -> str:
    """The reason that makes ``entry`` impossible after the entries ``before``, or ""."""
    if isinstance(entry, Opened):
        return "" if entry.keys else "has no captures"
    if isinstance(entry, Started):
        if (entry.level is not None) != before.shares_seeds and before.started:
            return "tests on other seeds than the ideas before"
        if entry.idea in (*before.started, BASELINE):
            return f"begins {entry.idea!r} a second time"
        if entry.against not in (BASELINE, *before.kept):
            return f"compares with {entry.against!r}, which was not kept"
        same = entry.keys.keys() == before.keys_of(entry.against).keys()
        return "" if same else f"has other captures than {entry.against!r}"
    if isinstance(entry, Promoted | Ended):
        verb = "ends" if isinstance(entry, Ended) else "tests"
        if entry.idea not in before.started:
            return f"{verb} {entry.idea!r}, which was not begun"
        if before.is_decided(entry.idea):
            return f"decides {entry.idea!r} a second time"
        if isinstance(entry, Ended):
            untested = entry.idea not in before.tests and not before.shares_seeds
            if entry.result == KEPT and untested:
                return f"keeps {entry.idea!r} without a test"
            return _fault_of_size(before.opened, entry.difference)
        if entry.idea in before.tests:
            return f"tests {entry.idea!r} a second time"
        return "tests with seeds that ideas have seen" if before.has_seen(entry.seeds) else ""
    if isinstance(entry, Confirming):
        known = {BASELINE, *before.kept}
        if BASELINE not in entry.keys or not entry.keys.keys() <= known:
            return "confirms ideas that were not kept, or lacks the baseline"
        scenes = entry.keys[BASELINE].keys()
        same = bool(scenes) and all(own.keys() == scenes for own in entry.keys.values())
        return "" if same else "confirms ideas on different captures, or on none"
    begun = before.confirmations
    if entry.number >= len(begun) or begun[entry.number][1] is not None:
        return "ends a confirmation that was not begun, or was ended before"
    ideas = begun[entry.number][0].keys.keys() - {BASELINE}
    if entry.results.keys() != ideas or not entry.differences.keys() <= ideas:
        return "has results of other ideas than its confirmation"
    faults = (
        _fault_of_size(before.opened, difference) for difference in entry.differences.values()
    )
    return next(filter(None, faults), "")


def _fault_of_size(opened: Opened, difference: Difference | None) -> str:
    """Logarithms of ratios are small; the ratio of a larger one would be no number."""
    if difference is None or not opened.relative:
        return ""
    ends = (difference.mean, difference.low, difference.high)
    return "" if max(map(abs, ends)) <= LARGEST_LOG else "has a difference that cannot be"


LARGEST_LOG = 100.0  # of a relative difference: a factor of 1e43
MEND = "bring back the file as gsbench wrote it, or begin another ledger"


def begin_ledger(home: Path, opened: Opened) -> Ledger:
    """Write the first line of a new ledger in ``home``, or return the ledger that has this line."""
    require_no_links(home.parent, home)
    with hold(home / f".{LEDGER}.lock", "the ledger"):
        if (home / LEDGER).exists():
            return read_ledger(home)
        _write(home, "", "", opened)
        return read_ledger(home)


def append(home: Path, make: Callable[[Ledger], Entry | None]) -> Ledger:
    """Append the entry that ``make`` gives for the present ledger; None appends nothing.

    Other processes cannot append meanwhile, so ``make`` sees all entries before its own.
    """
    with hold(home / f".{LEDGER}.lock", "the ledger"):
        ledger = read_ledger(home)
        entry = make(ledger)
        if entry is None:
            return ledger
        _write(home, _whole(read_bytes(home / LEDGER)).decode(), ledger.head, entry)
        return read_ledger(home)


def _whole(content: bytes) -> bytes:
    """The content with its last line break, which an editor may have removed."""
    return content if content.endswith(b"\n") or not content else content + b"\n"


def _write(home: Path, text: str, head: str, entry: Entry) -> None:
    """Replace the file as a whole, so that a kill leaves the old file or the new one."""
    write_text(home / LEDGER, text + _line(head, as_json(entry)))


def as_json(entry: Entry) -> dict[str, Any]:
    """The JSON object of an entry."""
    return {"kind": entry.kind} | entry.to_json()


def chained(entries: Iterable[Mapping[str, Any]]) -> str:
    """The content of a ledger with these entries (`as_json`)."""
    text = head = ""
    for entry in entries:
        line = _line(head, entry)
        text, head = text + line, hashlib.sha256(line.encode()).hexdigest()
    return text


def _line(before: str, entry: Mapping[str, Any]) -> str:
    own = hashlib.sha256(f"{before} {json.dumps(entry)}".encode()).hexdigest()
    return json.dumps({"before": before, "own": own, "entry": entry}, ensure_ascii=False) + "\n"
