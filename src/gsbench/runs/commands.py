"""The commands of an experiment and their questions: ``<runs>/<experiment>/commands.jsonl``.

A command adds a line before its trials run: its words, its trials, and the questions that no
earlier command asked, each with its level. A finished trial adds a line, too, so that what was seen
is known when its folder is gone. Lines are never changed; each has the digest of the one before.
Loads no torch.
"""

import json
import os
import sys
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from hashlib import sha256
from itertools import chain
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from gsbench.files import open_plain, require_no_links
from gsbench.parsing import Amount, Count, DamagedError, Raw, Record, Text, parse_typed, read_bytes
from gsbench.runs.code import config_hash, edited, states_of, user_modules
from gsbench.runs.configuration import SHOWN, Values, sha256_of
from gsbench.runs.experiments import Arm, make_home
from gsbench.runs.keys import CODE_OF_STAGE
from gsbench.runs.layout import COMMANDS, SEED
from gsbench.runs.trial_record import FROM_RENDERS
from gsbench.settings import ARM_BYTES, is_folder_name
from gsbench.system.locks import hold
from gsbench.words import counted

ERROR_RATE = 0.05
BASELINE = "baseline"  # the name of a ledger's own baseline among its ideas
ID_CHARACTERS, LINK_CHARACTERS = 12, 16
LEVELS = 3  # folders of scene, arm and trial
Place = tuple[str, int]  # scene and seed
# sources of a question's level: a command, the rules of a ledger, a gate, a table of results
# (declared before it, or not), a declaration of gsbench 0.1
Rule = Literal[
    "command",
    "screening",
    "lond",
    "confirmation",
    "gate",
    "table",
    "declared table",
    "declaration",
]
# arm, hash of the settings and, after a plus, that of the code: ``sfm-mine/3fa9c1d2+9ab01c22``
Digest = str


def _checked_folder(name: str) -> str:
    parts = name.split("/")
    if len(parts) != LEVELS or not all(is_folder_name(part, ARM_BYTES) for part in parts):
        raise ValueError("it is not a folder of a trial")
    return name


Folder = Annotated[str, AfterValidator(_checked_folder)]  # of a trial, in its experiment's


def make_digest(arm: str, config_hash: str, sources: Mapping[str, str], packages: Any) -> Digest:
    """The digest of an arm on a scene: its settings, the user's modules, and edited packages.

    What is as released does not count, so an update of gsbench changes nothing.
    """
    code = code_digest(sources, packages)
    return f"{arm}/{config_hash}{code and '+'}{code}"


def shared_hash(config_hash: str, densify: Mapping[str, Any]) -> str:
    """The hash of the settings in a digest: for renders of other programs, that of their method.

    Each set of pictures has a folder of its own, but all seeds are of one method.
    """
    is_renders = densify.get("evaluated_from") == FROM_RENDERS
    return sha256_of(dict(densify))[:SHOWN] if is_renders else config_hash


def code_digest(sources: Mapping[str, str], packages: Mapping[str, str]) -> str:
    """The digest of a user's modules and of the packages that differ from the release, or ""."""
    changed = edited(packages)
    return sha256_of([dict(sources), changed])[:SHOWN] if sources or changed else ""


def digest_of(values: Values) -> Digest:
    """The digest of a trial with the configuration ``values``, by the code as it is now."""
    arm = f"{values['init']['name']}-{values['densify']['name']}"
    packages = states_of(chain(*CODE_OF_STAGE.values()))
    return make_digest(arm, config_hash(values)[:SHOWN], user_modules(values), packages)


def code_in(digest: Digest) -> str:
    """The part of a digest that is about the code."""
    return digest.partition("+")[2]


class Question(Record):
    """A question: is ``idea`` better than ``baseline`` in ``metric``, by trials yet to come?

    - ``sign``: of the claimed difference, idea minus baseline; 0 if no difference is claimed.
    - ``least``: the least difference that matters, in the metric's unit or (``relative``) as a
      fraction of the baseline's value; None if it is not known.
    - ``digests``: of the baseline and of the idea on each scene; that of a baseline is "" until a
      later command trains it.
    - ``seeds``: of each scene, in the order of adding them.
    - ``looks``: the rising numbers of seeds at which it may be decided; all at once without.
    - ``rule``: what gave the ``level``, for the ``n``-th command about the idea on these seeds.
    - ``untested``: why no test is valid, since it was asked in view of results; "" if one is.
    """

    idea: Arm
    baseline: Arm
    metric: str
    sign: Literal[-1, 0, 1] = 1
    least: Amount | None = None
    relative: bool = False
    digests: dict[str, tuple[Digest, Digest]] = field(default_factory=dict)
    seeds: dict[str, tuple[Count, ...]] = field(default_factory=dict)
    looks: tuple[Count, ...] = ()
    rule: Rule = "command"
    n: Count = 1
    level: Amount = ERROR_RATE
    untested: str = ""
    name: str = ""
    says: str = ""
    where: str = ""
    versions: bool = False  # the two are versions of one trainer, so their code may differ
    id: str = ""

    def __post_init__(self) -> None:
        if self.digests.keys() != self.seeds.keys():
            raise ValueError("digests and seeds are of other scenes")

    @property
    def places(self) -> set[Place]:
        return {(scene, seed) for scene, seeds in self.seeds.items() for seed in seeds}

    @property
    def trials(self) -> int:
        """The number of its trials, of both sides."""
        return 2 * len(self.places)

    def covers(self, other: "Question") -> bool:
        """Return whether this asks the same, about all trials of ``other``."""

        terms = attrgetter("metric", "sign", "baseline.name", "rule")
        return (
            terms(self) == terms(other)
            and other.places <= self.places
            and all(
                (self.digests[scene][0] == first or "" in (self.digests[scene][0], first))
                and self.digests[scene][1] == second
                for scene, (first, second) in other.digests.items()
            )
        )

    def has(self, digest: Digest, scene: str, seed: int) -> bool:
        """Return whether it is about the trial with this digest, of either side."""
        return digest in self.digests.get(scene, ()) and seed in self.seeds[scene]

    def with_id(self, salt: object) -> "Question":
        return replace(self, id=sha256_of([self.to_json(), salt])[:ID_CHARACTERS])


class PlannedTrial(Record):
    """A planned trial: its words and digest, and folder and Unix time of its command."""

    words: tuple[Raw, ...]
    digest: Digest = ""
    cwd: Raw = ""
    time: Amount = 0.0


class Idea(Record):
    """An idea of a ledger: the settings as words, and the digest on each scene.

    ``identity`` is the hash of its settings and code without names: equal ones are one idea. It is
    compared with the idea ``against``; the ledger's `BASELINE` with none.
    """

    name: Text
    identity: Text
    words: tuple[Raw, ...]
    digests: dict[str, Digest]
    against: str = ""


class Ledger(Record):
    """The terms of a ledger: the metric that decides, the seeds, how many ideas share the ``rate``.

    ``least`` is the least difference in ``metric`` that matters, a fraction of the baseline's value
    if ``relative``. ``rate`` is the false discovery rate.
    """

    metric: Text
    sign: Literal[-1, 1]
    least: Amount
    relative: bool
    ideas: Annotated[int, Field(ge=1)]
    rate: Annotated[float, Field(gt=0, lt=1)]
    seeds: Annotated[tuple[Count, ...], Field(min_length=2)]


class Command(Record):
    """A command: its trials by their folders, and the questions that it asked first.

    ``shows`` are the ids of earlier questions that it repeats: these are its idea's newest. It may
    open a ``ledger``, and begin an ``idea`` of it.
    """

    words: tuple[Raw, ...]
    cwd: Raw
    time: Amount
    trials: dict[Folder, PlannedTrial] = field(default_factory=dict)
    questions: tuple[Question, ...] = ()
    shows: tuple[str, ...] = ()
    dropped: tuple[Folder, ...] = ()  # trials that are no longer planned
    ledger: Ledger | None = None
    idea: Idea | None = None
    previous: str = ""


class Finished(Record):
    """A trial that gave a result."""

    finished: Folder
    digest: Digest
    previous: str = ""

    @property
    def place(self) -> Place:
        scene, _, trial = self.finished.split("/")
        return scene, int(trial.partition(SEED)[2])


Line = Command | Finished


def command_now(words: Sequence[str] | None = None, **parts: Any) -> Command:
    """A command of this process and moment; by default its words are those of the process."""
    own = sys.argv[1:] if words is None else words
    return Command(words=tuple(own), cwd=os.getcwd(), time=time.time(), **parts)


@dataclass(frozen=True)
class History:
    """All that was asked in an experiment, and what gave results, in order.

    ``faults`` name damaged lines and broken links; other lines stay valid. ``head`` is the digest
    of the last line.
    """

    home: Path
    commands: tuple[Command, ...] = ()
    results: frozenset[tuple[Digest, Place]] = frozenset()
    faults: tuple[str, ...] = ()
    head: str = ""

    @property
    def ledger(self) -> Ledger | None:
        """The terms of its ledger of ideas; None if it is none."""
        return next((one.ledger for one in self.commands if one.ledger), None)

    @cached_property
    def ideas(self) -> dict[str, Idea]:
        """The ideas of its ledger in their order, the baseline first."""
        return {one.idea.name: one.idea for one in self.commands if one.idea}

    @cached_property
    def planned(self) -> dict[Path, PlannedTrial]:
        """The planned trials by their folders."""
        found: dict[str, PlannedTrial] = {}
        for one in self.commands:
            for name, trial in one.trials.items():
                found[name] = replace(trial, cwd=one.cwd, time=one.time)
            for name in one.dropped:
                found.pop(name, None)
        return {self.home / name: trial for name, trial in sorted(found.items())}

    @cached_property
    def questions(self) -> tuple[Question, ...]:
        """All questions, those that were asked or repeated last at the end.

        An awaited baseline has the digest that the first later command gives it.
        """
        by_id: dict[str, Question] = {}
        for number, one in enumerate(self.commands):
            for question in one.questions:
                by_id[question.id] = self._with_baseline(question, self.commands[number:])
            for name in one.shows:
                if name in by_id:
                    by_id[name] = by_id.pop(name)
        return tuple(by_id.values())

    @property
    def last(self) -> set[str]:
        """The ids of the questions that the last command which asked anything asked or repeated."""
        asked = ({*(q.id for q in one.questions), *one.shows} for one in reversed(self.commands))
        return next(filter(None, asked), set())

    def _with_baseline(self, question: Question, later: Sequence[Command]) -> Question:
        if all(first for first, _ in question.digests.values()):
            return question
        trained: dict[str, Digest] = {}
        for name, trial in chain(*(one.trials.items() for one in later)):
            scene, arm, _ = name.split("/")
            if arm == question.baseline.name and trial.digest:
                trained.setdefault(scene, trial.digest)
        digests = {
            scene: (first or trained.get(scene, ""), second)
            for scene, (first, second) in question.digests.items()
        }
        return replace(question, digests=digests)

    def covering(self, digest: Digest, scene: str, seed: int) -> list[Question]:
        """The questions about a trial."""
        return [one for one in self.questions if one.has(digest, scene, seed)]


def read_history(home: Path) -> History:
    """Commands and questions of the experiment in ``home``; nothing without a file.

    What cannot be read is named in ``faults`` and left out.
    """
    commands, results, before = list[Command](), set[tuple[Digest, Place]](), ""
    unread, damaged, unlinked = list[str](), list[str](), list[str]()
    try:
        lines = _lines(home)
    except DamagedError as error:
        lines = []
        unread.append(f"{COMMANDS} {error.reason}")
    for number, (text, line) in enumerate(lines, 1):
        if isinstance(line, DamagedError):
            damaged.append(f"line {number} of {COMMANDS} {line.reason}")
        elif line.previous != before:
            unlinked.append(
                f"line {number} of {COMMANDS} does not follow the one before it: a line was "
                "changed, added or removed"
            )
        if isinstance(line, Command):
            commands.append(line)
        elif isinstance(line, Finished):
            results.add((line.digest, line.place))
        before = _link(text)
    # a file of garbage has many lines, of which the first says enough
    for first, *others in filter(None, (damaged, unlinked)):
        unread.append(f"{first} (and {counted(len(others), 'more line')})" if others else first)
    faults = tuple(f"{home.name}: {fault}" for fault in unread)
    return History(home, tuple(commands), frozenset(results), faults, before)


def _lines(home: Path) -> list[tuple[bytes, Line | DamagedError]]:
    """The lines of the file, each as text and read, or with what is wrong with it."""
    found = list[tuple[bytes, Line | DamagedError]]()
    for text in _content(home / COMMANDS).splitlines():
        kind: type[Line] = Finished if text.startswith(b'{"finished"') else Command
        try:
            found.append((text, parse_typed(text, kind, home / COMMANDS)))
        except DamagedError as error:
            found.append((text, error))
    return found


def read_lines(home: Path) -> list[Line]:
    """The sound lines of the file, in order."""
    return [line for _, line in _lines(home) if not isinstance(line, DamagedError)]


def append(home: Path, make: Callable[[History], Command | None]) -> Command | None:
    """Add the command that ``make`` makes of the history so far; None adds none.

    One process at a time does so; the line is on the disk when this returns.
    """
    with _held(home) as path:
        line = make(read_history(home))
        if line is not None:
            _write(path, line)
    return line


def remember_result(home: Path, folder: Path, digest: Digest) -> None:
    """Record that the trial in ``folder`` gave a result, unless that is known."""
    done = Finished(finished=folder.relative_to(home).as_posix(), digest=digest)
    with _held(home) as path:
        # not parsed, since each of thousands of trials comes here
        if _text(done).removesuffix("}").encode() not in _content(path):
            _write(path, done)


@contextmanager
def _held(home: Path) -> Iterator[Path]:
    make_home(home)
    path = home / COMMANDS
    require_no_links(home.parent, path)
    with hold(home / f".{COMMANDS}.lock", "the experiment's commands"):
        yield path


def _write(path: Path, line: Line) -> None:
    content = _content(path)
    torn = bool(content) and not content.endswith(b"\n")  # by a kill or a full disk
    last = _link(content.splitlines()[-1]) if content else ""
    text = _text(replace(line, previous=last)).encode()
    flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND
    with os.fdopen(open_plain(path, flags), "wb") as file:
        file.write(b"\n" * torn + text + b"\n")
        file.flush()
        os.fsync(file.fileno())


def drop(home: Path, folders: Collection[Path]) -> None:
    """Plan the trials in ``folders`` no longer."""
    names = tuple(folder.relative_to(home).as_posix() for folder in folders)
    now = command_now((), dropped=names)
    append(home, lambda history: now if history.planned.keys() & set(folders) else None)


def chained(lines: Iterable[Line]) -> str:
    """The text of a file with these lines, linked anew."""
    texts, before = list[str](), ""
    for line in lines:
        texts.append(_text(replace(line, previous=before)))
        before = _link(texts[-1].encode())
    return "".join(f"{text}\n" for text in texts)


def _content(path: Path) -> bytes:
    try:
        return read_bytes(path)
    except FileNotFoundError:
        return b""


def _text(line: Line) -> str:
    return json.dumps(line.to_json())


def _link(text: bytes) -> str:
    return sha256(text).hexdigest()[:LINK_CHARACTERS]
