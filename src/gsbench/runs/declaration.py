"""The record of what an experiment was declared to be about: ``<runs>/<experiment>/declared.jsonl``.

Every line is one `Declaration`, written when a command is given and before its trials run. ``eval.primary``, a file of
claims and ``launch.stop_when_decided`` each become one. A trial's ``results.json`` repeats the metric that stood when
it was run. `gsbench.analysis.judgement` judges by declarations, and `gsbench.analysis.declaration` says what came
before and after them.
"""

import calendar
import json
import logging
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from gsbench.parsing import DamagedError, read_bytes
from gsbench.records import STRICT, Amount, Count, Record, iterate_rows
from gsbench.runs.keys import sha256_of
from gsbench.runs.layout import DECLARED
from gsbench.runs.trial_record import Declared

log = logging.getLogger(__name__)

INTERPOLATION, EXTRAPOLATION = "interpolation", "extrapolation"
QUESTIONS = {"every_nth": INTERPOLATION, "sector": EXTRAPOLATION}  # what a split (scene.split) asks of a model
AT = "@"  # psnr@extrapolation
STAMP = "%Y-%m-%dT%H:%M:%SZ"  # UTC, as in the manifests of the store
ERROR_RATE = 0.05

TrialKey = Annotated[str, Field(pattern=r"^[^/]*/[^/]*/[^/]*$")]
Planned = Mapping[str, tuple[int, ...]]  # seeds by scene, arm and hash of the configuration (`trial_key`)


def trial_key(scene: str, arm: str, config_hash: str) -> str:
    """The name that tells a trial from others of its experiment but for the seed: ``garden/sfm-adc/3fa9c1d2``."""
    return f"{scene}/{arm}/{config_hash}"


@dataclass(frozen=True, order=True)
class Arm:
    """An arm of a comparison: an initialiser, a densifier, and the swept settings that tell it from others of the two.

    ``variant`` holds the items of a mapping from a setting to its value as text. A file of claims names its arms
    itself; they have no ``init``.
    """

    __pydantic_config__ = STRICT

    init: str
    densify: str
    variant: tuple[tuple[str, str], ...] = ()

    def __str__(self) -> str:
        name = f"{self.init}-{self.densify}" if self.init else self.densify
        return " ".join([name, *(f"{key.rpartition('.')[2]}={value}" for key, value in self.variant)])


@dataclass(frozen=True, kw_only=True)
class Question(Record):
    """A question: does ``arm`` differ from ``baseline`` in ``metric``, the way ``sign`` says, by ``least`` at least?

    ``sign`` is that of the claimed difference, arm minus baseline; 0 where it is claimed that there is none. ``least``
    is the smallest difference that matters, in the metric's unit or (``relative``) as a part of the baseline's value;
    None where nobody said. ``scenes`` gives for each scene the folders of both arms' trials within the experiment,
    without the seed (`trial_key`); without it, the trials are those of the two arms, on all scenes. ``seeds`` are in
    the order in which they are added; without them, all that both arms have count. A question without arms is about
    every two arms that are compared, in the metric's own direction, ``about`` interpolation or extrapolation where it
    says so. Of two ``versions`` of one trainer the code may differ, and the baseline's trials may be older than the
    question.
    """

    metric: str
    sign: int = 1
    least: Amount | None = None
    relative: bool = False
    baseline: Arm | None = None
    arm: Arm | None = None
    scenes: dict[str, tuple[TrialKey, TrialKey]] = field(default_factory=dict)
    seeds: tuple[Count, ...] = ()
    about: str = ""
    secondary: bool = False
    versions: bool = False
    name: str = ""

    @property
    def planned(self) -> Planned:
        """The trials that the question names."""
        return {key: self.seeds for keys in self.scenes.values() for key in keys}


@dataclass(frozen=True, kw_only=True)
class Declaration(Record):
    """Questions that were asked at ``time`` (UTC), which share ``error_rate``, the chance that any answer is false.

    ``looks`` are numbers of seeds, rising: after each of them a question may be decided; none: all is judged once.
    ``trials`` are all that were to be run where the questions name none; None: nobody knows. ``missing`` says by
    question what of it could not be tested where it was declared, and why.
    """

    time: str
    questions: tuple[Question, ...] = ()
    error_rate: Amount = ERROR_RATE
    looks: tuple[Count, ...] = ()
    trials: dict[TrialKey, tuple[Count, ...]] | None = None
    missing: dict[str, list[str]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if unix_time(self.time) is None:
            raise ValueError("time is not a time")

    @property
    def moment(self) -> int:
        """The time in Unix seconds."""
        return unix_time(self.time) or 0

    @property
    def when(self) -> str:
        """``2026-11-21 20:05 UTC``"""
        return time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(self.moment))

    @property
    def of_claims(self) -> bool:
        """Return whether a file of claims was declared, each question of which has a name."""
        return any(question.name for question in self.questions)

    @property
    def primary(self) -> str:
        """The metric that a sweep was declared to be about, as ``eval.primary`` names it."""
        first = self.questions[0]
        return f"{first.metric}{AT}{first.about}" if first.about else first.metric

    @property
    def names_trials(self) -> bool:
        """Return whether it is known which trials were to be run: not in what a trial repeats."""
        return self.trials is not None or any(question.scenes for question in self.questions)

    @property
    def planned(self) -> Planned:
        """All trials that were to be run."""
        found: dict[str, tuple[int, ...]] = dict(self.trials or {})
        for question in self.questions:
            found = dict(merge_planned(found, question.planned))
        return found

    @property
    def hash(self) -> str:
        """sha256 of all that decides about the answers: another one is another declaration."""
        return sha256_of(replace(self, time="1970-01-01T00:00:00Z", missing={}).to_json())

    def summary(self) -> Declared:
        """The part that a trial repeats."""
        return Declared(metric=self.primary, time=self.time)


def declared_now(**values: Any) -> Declaration:
    """A declaration of this moment."""
    return Declaration(time=time.strftime(STAMP, time.gmtime()), **values)


def metric_and_question(primary: str) -> tuple[str, str]:
    """The metric that ``eval.primary`` names, and the question that it is about; "" for all that were asked.

    Examples:
        >>> metric_and_question("psnr@extrapolation")
        ('psnr', 'extrapolation')
        >>> metric_and_question("psnr")
        ('psnr', '')
    """
    metric, _, question = primary.partition(AT)
    return metric, question


def open_question(primary: str) -> Question:
    """The question of ``eval.primary``: every two arms in one metric."""
    metric, about = metric_and_question(primary)
    return Question(metric=metric, sign=0, about=about)


def read_declarations(folder: Path, repeated: Iterable[Declared | None] = ()) -> list[Declaration]:
    """Read every declaration for the experiment in ``folder``, the oldest first.

    Those that only results of its trials record are ``repeated``.
    """
    path = folder / DECLARED
    try:
        content = read_bytes(path)
    except FileNotFoundError:
        content = b""
    except DamagedError as error:
        log.warning("left out: %s", error)
        content = b""
    found = [one for _, one in iterate_rows(content, Declaration, path) if one.questions]
    known = {(one.primary, one.time) for one in found}
    for one in dict.fromkeys((said.metric, said.time) for said in repeated if said is not None):
        if one not in known and unix_time(one[1]) is not None:
            found.append(Declaration(time=one[1], questions=(open_question(one[0]),)))
    return sorted(found, key=lambda declaration: declaration.moment)


def latest_declaration(declarations: Sequence[Declaration]) -> Declaration:
    """The latest of ``declarations``, which are in the order of time, with the time from which on it stood."""
    first = len(declarations) - 1
    while first > 0 and declarations[first - 1].hash == declarations[-1].hash:
        first -= 1
    return declarations[first]


def merge_planned(one: Planned, other: Planned) -> Planned:
    """The trials of both."""
    return {key: tuple(sorted({*one.get(key, ()), *other.get(key, ())})) for key in {**one, **other}}


def record_text(declarations: Iterable[Declaration]) -> str:
    """The content of ``declared.jsonl``, in the order of time."""
    entries = sorted(declarations, key=lambda entry: entry.moment)
    return "".join(json.dumps(entry.to_json()) + "\n" for entry in entries)


def unix_time(text: object) -> int | None:
    """The moment that a stamp names; None for what is none."""
    try:
        return calendar.timegm(time.strptime(str(text), STAMP))
    except (ValueError, OverflowError):
        return None
