"""Experiments in a runs folder, searches that tune an arm (``tuning.json``), and declarations."""

import calendar
import json
import logging
import os
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from gsbench.errors import InputError
from gsbench.files import require_no_links
from gsbench.parsing import STRICT, Amount, Count, Number, Record, Text, Whole
from gsbench.runs.layout import DECLARED, IN_RUNS
from gsbench.runs.nested import sha256_of
from gsbench.runs.rows import read_rows
from gsbench.runs.trial_record import Declared
from gsbench.settings import ARM_BYTES, is_folder_name

log = logging.getLogger(__name__)


def list_experiments(runs_dir: Path) -> list[str]:
    """The names of the experiments in a runs folder, sorted."""
    if not runs_dir.is_dir():
        return []
    return sorted(
        Path(folder).name for folder in folders_in(runs_dir) if Path(folder).name not in IN_RUNS
    )


def experiment_home(runs_dir: Path, name: str) -> Path:
    """The folder of the experiment ``name``; raises InputError if there is no such experiment."""
    names = list_experiments(runs_dir)
    if name not in names:
        raise InputError(
            f"no experiment {name!r} in {runs_dir}; there: {', '.join(names) or 'none yet'}"
        )
    return runs_dir / name


def make_home(home: Path) -> None:
    """Make the folder of an experiment; raises InputError if it is a link."""
    require_no_links(home.parent, home)
    home.mkdir(parents=True, exist_ok=True)


def trial_folders(home: Path) -> Iterator[str]:
    """The paths of all folders three levels below ``home`` (scene, arm, trial), in any order."""
    for scene in folders_in(home):
        for arm in folders_in(scene):
            yield from folders_in(arm)


def folders_in(folder: str | Path) -> list[str]:
    """The paths of the folders in ``folder``, without links, hidden folders and strange names."""
    try:
        with os.scandir(folder) as entries:
            found = [
                entry
                for entry in entries
                if entry.is_dir(follow_symlinks=False) and not entry.name.startswith(".")
            ]
    except OSError as error:
        log.warning("left out: %s cannot be read (%s)", folder, error.strerror)
        return []
    paths = []
    for entry in found:
        if is_folder_name(entry.name, ARM_BYTES):
            paths.append(entry.path)
        else:  # such as a line break, or a tag of HTML
            log.warning("left out: %r: gsbench gives no folder such a name", entry.path)
    return paths


# ---- the search for the settings of an arm


class SearchPoint(Record):
    """A point of a search.

    ``value`` is the mean of the metric over its trials, None if one of them has no value.
    """

    settings: dict[str, Whole | Number]
    value: Number | None


class TuningRecord(Record):
    """The search for the settings of ``arm`` (INIT-DENSIFY), which ``sweep`` then trains.

    ``ranges`` are the searched ranges as given, those in ``log`` on a logarithmic scale. ``wanted``
    is the number of points, each judged by trials of ``seeds`` on validation views of ``scenes``.
    """

    sweep: Text
    arm: Text
    metric: Text
    direction: Literal[-1, 1]
    wanted: Count
    seeds: list[Count]
    scenes: list[str]
    ranges: dict[str, str]
    log: list[str]
    points: list[SearchPoint]

    def __post_init__(self) -> None:
        if len({frozenset(point.settings) for point in self.points if point.value is not None}) > 1:
            raise ValueError("the points have different settings")
        for point in self.points:
            if any(point.settings.get(key, 1) <= 0 for key in self.log):
                raise ValueError("a setting of a log scale is not above 0")

    @property
    def best(self) -> SearchPoint | None:
        """The (first) point with the best value; None if no point has a value."""
        done = [point for point in self.points if point.value is not None]
        return max(done, key=lambda point: self.direction * (point.value or 0.0), default=None)


# ---- questions declared before the trials ran: ``<runs>/<experiment>/declared.jsonl``
#
# Every line is a `Declaration`. A command writes it before its trials run, for ``eval.primary``, a
# file of claims or ``launch.stop_when_decided``. A trial's ``results.json`` repeats the metric that
# was declared when it ran. `gsbench.analysis.judgement` answers the questions.

INTERPOLATION, EXTRAPOLATION = "interpolation", "extrapolation"
# the question of each split (scene.split)
QUESTIONS = {"every_nth": INTERPOLATION, "sector": EXTRAPOLATION}
AT = "@"  # psnr@extrapolation
STAMP = "%Y-%m-%dT%H:%M:%SZ"  # UTC, as in the manifests of the store
NO_TIME = "1970-01-01T00:00:00Z"  # of a declaration that is not kept
ERROR_RATE = 0.05

TrialKey = Annotated[str, Field(pattern=r"^[^/]*/[^/]*/[^/]*$")]
# seeds by scene, arm and hash of the configuration (`trial_key`)
Planned = Mapping[str, tuple[int, ...]]


def trial_key(scene: str, arm: str, config_hash: str) -> str:
    """The key of trials that differ only in the seed: ``garden/sfm-adc/3fa9c1d2``."""
    return f"{scene}/{arm}/{config_hash}"


@dataclass(frozen=True, order=True)
class Arm:
    """An arm of a comparison: initialiser, densifier, and the swept settings that distinguish it.

    ``variant`` holds (setting, value as text) pairs. The arms of a file of claims have its names
    and no ``init``.
    """

    __pydantic_config__ = STRICT

    init: str
    densify: str
    variant: tuple[tuple[str, str], ...] = ()

    def __str__(self) -> str:
        return f"{self.init}-{self.short}" if self.init else self.short

    @property
    def name(self) -> str:
        """The name without the swept settings: ``sfm-momentum``"""
        return f"{self.init}-{self.densify}" if self.init else self.densify

    @property
    def short(self) -> str:
        """The name without the initialiser: ``momentum[decay=0.9]``"""
        values = ", ".join(f"{key.rpartition('.')[2]}={value}" for key, value in self.variant)
        return f"{self.densify}[{values}]" if values else self.densify

    def has(self, name: str, config: Mapping[str, Any]) -> bool:
        """Return whether a trial of the arm called ``name`` with these settings belongs to it."""
        own = f"{self.init}-{self.densify}"
        return name == own and all(str(config.get(key)) == value for key, value in self.variant)


class Question(Record):
    """A question: is ``arm`` better than ``baseline`` in ``metric`` (``sign``) by ``least``?

    - ``sign``: of the claimed difference, arm minus baseline; 0 if no difference is claimed.
    - ``least``: the smallest difference that matters, in the metric's unit or (``relative``) as a
      fraction of the baseline's value; None if it is not known.
    - ``scenes``: for each scene, the keys (`trial_key`) of baseline's and arm's trials; if empty,
      the trials are those of the two arms on all scenes.
    - ``seeds``: in the order of adding them; if empty, all seeds that both arms have.
    - ``baseline`` and ``arm`` are None in a question about all compared arms, in the metric's own
      direction.
    - ``about``: "interpolation" or "extrapolation", "" for both.
    - ``versions``: the arms are versions of one trainer, so their code may differ.
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
        """The trials that the question names; {} without ``scenes``."""
        return {key: self.seeds for keys in self.scenes.values() for key in keys}


class Declaration(Record):
    """Questions that were declared at ``time`` (UTC).

    ``error_rate`` is the chance that any answer is false. ``looks`` are the rising numbers of
    seeds at which a question may be decided; without looks, all seeds are judged at once.
    ``trials`` are the planned trials if the questions name none; None if they are not recorded.
    ``known`` are those of them whose results were there already, although their times are later: a
    clock was set back. ``missing`` says by question what could not be tested, and why. ``votes`` is
    the number of people's votes at which the questions of the round ``vote_round`` are judged.
    """

    time: str
    questions: tuple[Question, ...] = ()
    error_rate: Amount = ERROR_RATE
    looks: tuple[Count, ...] = ()
    trials: dict[TrialKey, tuple[Count, ...]] | None = None
    known: dict[TrialKey, tuple[Count, ...]] = field(default_factory=dict)
    missing: dict[str, list[str]] = field(default_factory=dict)
    votes: Count = 0
    vote_round: str = ""

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
        return display_time(self.time)

    @property
    def kind(self) -> Literal["sweep", "claims", "votes"]:
        """The subject: a sweep's metric, people's votes, or claims (of a file or a gate).

        Questions of claims have names; those of a sweep have none.
        """
        if self.vote_round:
            return "votes"
        return "claims" if any(question.name for question in self.questions) else "sweep"

    @property
    def primary(self) -> str:
        """The declared metric of a sweep, as in ``eval.primary``."""
        first = self.questions[0]
        return f"{first.metric}{AT}{first.about}" if first.about else first.metric

    @property
    def names_trials(self) -> bool:
        """Return whether the planned trials are recorded.

        The part that a trial's results repeat does not have them.
        """
        return self.trials is not None or any(question.scenes for question in self.questions)

    @property
    def planned(self) -> Planned:
        """All planned trials."""
        planned: dict[str, tuple[int, ...]] = dict(self.trials or {})
        for question in self.questions:
            planned = dict(merge_planned(planned, question.planned))
        return planned

    @property
    def hash(self) -> str:
        """sha256 of all that affects the answers: different hashes are different declarations."""
        return sha256_of(replace(self, time=NO_TIME, missing={}, known={}).to_json())

    def summary(self) -> Declared:
        """The part that a trial's results.json repeats."""
        return Declared(metric=self.primary, time=self.time)


def declared_now(**values: Any) -> Declaration:
    """A declaration with the present time."""
    return Declaration(time=stamp_now(), **values)


def metric_and_question(primary: str) -> tuple[str, str]:
    """The metric and the question that ``eval.primary`` names; the question is "" for both.

    Examples:
        >>> metric_and_question("psnr@extrapolation")
        ('psnr', 'extrapolation')
        >>> metric_and_question("psnr")
        ('psnr', '')
    """
    metric, _, question = primary.partition(AT)
    return metric, question


def open_question(primary: str) -> Question:
    """The question of ``eval.primary``, about all compared arms in one metric."""
    metric, about = metric_and_question(primary)
    return Question(metric=metric, sign=0, about=about)


def read_declarations(folder: Path, repeated: Iterable[Declared | None] = ()) -> list[Declaration]:
    """All declarations of the experiment in ``folder``, the oldest first.

    ``repeated`` are the declarations in its trials' results. They are added if the file lacks them.
    """
    declarations: list[Declaration] = [
        row for row in read_rows(folder / DECLARED, Declaration) if row.questions
    ]
    in_file = {(declaration.primary, declaration.time) for declaration in declarations}
    for metric, when in dict.fromkeys((known.metric, known.time) for known in repeated if known):
        if (metric, when) not in in_file and unix_time(when) is not None:
            declarations.append(Declaration(time=when, questions=(open_question(metric),)))
    return sorted(declarations, key=lambda declaration: declaration.moment)


def latest_declaration(declarations: Sequence[Declaration]) -> Declaration:
    """The latest of ``declarations``, with the time since when it has been in force.

    ``declarations`` are in the order of time. If the last ones are equal, the first of these is
    returned.
    """
    first = len(declarations) - 1
    while first > 0 and declarations[first - 1].hash == declarations[-1].hash:
        first -= 1
    return declarations[first]


def of_latest_metric(sweeps: Sequence[Declaration]) -> tuple[Declaration, ...]:
    """The declarations of the latest metric after the last one of another metric.

    ``sweeps`` are declarations of sweeps, in the order of time.
    """
    latest = sweeps[-1]
    others = [sweep.moment for sweep in sweeps if sweep.primary != latest.primary]
    return tuple(
        sweep
        for sweep in sweeps
        if sweep is latest
        or (sweep.primary == latest.primary and sweep.moment > max(others, default=-1))
    )


def merge_planned(one: Planned, other: Planned) -> Planned:
    """The trials of both plans."""
    return {
        key: tuple(sorted({*one.get(key, ()), *other.get(key, ())})) for key in {**one, **other}
    }


def record_text(declarations: Iterable[Declaration]) -> str:
    """The content of ``declared.jsonl``, in the order of time."""
    ordered = sorted(declarations, key=lambda declaration: declaration.moment)
    return "".join(json.dumps(declaration.to_json()) + "\n" for declaration in ordered)


def stamp_now() -> str:
    """The present time as a time stamp (`STAMP`)."""
    return time.strftime(STAMP, time.gmtime())


def display_time(stamp: str) -> str:
    """A time stamp (`STAMP`) for people: ``2026-11-21 20:05 UTC``."""
    return time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(unix_time(stamp) or 0))


def unix_time(text: object) -> int | None:
    """The Unix time of a time stamp (`STAMP`); None if the text is not one."""
    try:
        return calendar.timegm(time.strptime(str(text), STAMP))
    except (ValueError, OverflowError):
        return None
