"""Plan of a tuning: the arms of a sweep, what is searched of each, by which metric, views and seeds.

What is tuned is given as intervals among the words of the sweep, or below ``hydra.sweeper.tune``: the number of points
and, for each arm, the ranges of its settings. A search is the tuning of one arm. Each arm's points are trained in an
experiment of its own, so that no table holds them; the first is the arm as it is, where that lies in the ranges.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from pydantic import NonNegativeInt, PositiveInt

from gsbench.app.study import (
    Goal,
    Ranges,
    Study,
    Values,
    check_installed,
    distribution,
    lowest,
    sign_of,
    text_of,
    words_of_values,
)
from gsbench.app.sweep import Sweep, grid
from gsbench.config.command_words import parse_word
from gsbench.errors import InputError
from gsbench.launch.trial import Trial
from gsbench.runs.declaration import metric_and_question
from gsbench.runs.hashing import config_hash, sha256_of
from gsbench.runs.search_record import is_value
from gsbench.settings import check_settings
from gsbench.words import closest, counted, listed

PLACE = "hydra.sweeper.tune"
DEFAULT_METRIC = "psnr"
DEFAULT_POINTS = 20  # of intervals on the command line
SEED = "seed"
MEASURED_ON = ("scene", "eval", "launch", "tracking", "hydra")  # groups that no arm may tune: they say how it is judged
REPLACED = (SEED, "name", "scene.validation", "eval.primary")  # words of a job that a point's trials have otherwise


@dataclass(frozen=True)
class TuneSettings:
    """Settings of a tuning. ``points`` are those of each arm; 0 and None: nothing is tuned.

    ``ranges`` maps an arm (``adc`` or ``sfm-adc``) to its settings, each with its values as on the command line;
    ``seed`` are the seeds of a point's trials, none of which the sweep may have. ``intervals``: the sweep's words have
    ranges as well.
    """

    points: NonNegativeInt | None = None
    at_once: PositiveInt = 1  # points of an arm that are chosen before the next result is known
    metric: str | None = None  # None: eval.primary, else PSNR
    direction: Literal["maximize", "minimize"] | None = None
    seed: int | str = 100
    ranges: dict[str, dict[str, Any]] = field(default_factory=dict)
    intervals: bool = False

    def __post_init__(self) -> None:
        check_settings(self, PLACE)
        if self.ranges and self.points is None:
            raise InputError(f"{PLACE}.ranges are given: say how many points each arm gets ({PLACE}.points=6; 0: none)")
        if self.points and not self.ranges and not self.intervals:
            raise InputError(
                f"{PLACE}.points={self.points}, and no ranges to search: give them by arm, as "
                f"{PLACE}.ranges.adc={{densify.gradient_threshold: 'tag(log, interval(1e-4, 4e-4))'}}, best in a file"
            )


@dataclass(frozen=True)
class Arm:
    """An arm of the sweep with what is searched of it; no ``ranges``: it stays as it is."""

    name: str
    experiment: str
    texts: Mapping[str, str]
    ranges: Ranges
    jobs: tuple[tuple[str, ...], ...]  # of the sweep, without what a point's trials have otherwise
    as_it_is: Values | None

    def trials(self, values: Values, seeds: Sequence[int]) -> list[list[str]]:
        """The words of a point's trials."""
        own = [f"name={self.experiment}", "scene.validation=true", "eval.primary=null", *words_of_values(values)]
        return [[*job, *own, f"{SEED}={seed}"] for job in self.jobs for seed in seeds]


@dataclass(frozen=True)
class Plan:
    """All that decides about what is tuned: written down, with its hash, before anything is trained."""

    home: Path
    goal: Goal
    seeds: tuple[int, ...]
    scenes: tuple[str, ...]
    arms: tuple[Arm, ...]
    identity: Mapping[str, str]  # by arm: of all settings of its points' trials but those that are searched

    @property
    def tuned(self) -> list[Arm]:
        return [arm for arm in self.arms if arm.ranges]

    def to_record(self) -> dict[str, Any]:
        arms = {arm.name: {"ranges": dict(arm.texts), "settings": self.identity.get(arm.name)} for arm in self.arms}
        plan = {
            "metric": self.goal.metric,
            "direction": self.goal.sign,
            "points": self.goal.points,
            "seeds": list(self.seeds),
            "views": "validation",
            "arms": arms,
        }
        return {"tuning": plan}

    @property
    def hash(self) -> str:
        return sha256_of(self.to_record())

    def study(self, arm: Arm) -> Study:
        ranges = {key: repr(one) for key, one in arm.ranges.items()}
        name = sha256_of([self.identity[arm.name], self.goal.metric, self.goal.sign, ranges, list(self.seeds)])[:16]
        home = self.home.parent / arm.experiment
        return Study(home, name, self.goal, arm.ranges, arm.as_it_is, seeds=len(self.seeds), arm=arm.name)

    def describe(self) -> str:
        """A line that a dry run prints of the search."""
        each = {arm.name: len(arm.jobs) * len(self.seeds) for arm in self.tuned}
        left = [arm.name for arm in self.arms if not arm.ranges]
        points, seeds = counted(self.goal.points, "point"), counted(len(self.seeds), "seed")
        return (
            f"tunes first: {points} each for {listed(list(each))}, by {self.goal.metric} of validation views on "
            f"{listed(self.scenes)} with {seeds}, {sum(each.values()) * self.goal.points} trainings"
            + (f"; not tuned: {listed(left)}" if left else "")
        )


def make_plan(
    begun: Sweep, wanted: TuneSettings, jobs: Sequence[Sequence[str]], searched: Sequence[Mapping[str, str]]
) -> Plan:
    """The plan of the tuning that ``wanted`` asks for of the arms of a sweep's jobs, and the intervals ``searched`` for
    each; raises InputError where it fits none."""
    check_installed()
    trials = begun.trials(jobs)
    homes = {trial.files.home for trial in trials}
    if len(homes) > 1:
        raise InputError(f"{PLACE}: all trials of the sweep need one name, got {listed(sorted(h.name for h in homes))}")
    if any(trial.values["scene"]["validation"] for trial in trials):
        raise InputError(f"{PLACE} searches on validation views by itself: leave scene.validation out")
    (home,) = homes
    metric = wanted.metric or _primary(trials) or DEFAULT_METRIC
    goal = Goal(metric, sign_of(metric, wanted.direction, PLACE), wanted.points or 0, wanted.at_once)
    seeds = _seeds(wanted, trials)
    arms = tuple(_arms(begun, wanted, jobs, searched, trials))
    identity = {}
    for arm in arms:
        first = begun.trials(arm.trials(lowest(arm.ranges), seeds)) if arm.ranges else []
        identity[arm.name] = sha256_of([config_hash(trial.values) for trial in first])[:16]
    scenes = tuple(dict.fromkeys(trial.values["scene"]["name"] for trial in trials))
    return Plan(home, goal, seeds, scenes, arms, identity)


def _primary(trials: Sequence[Trial]) -> str:
    declared = {str(trial.values["eval"].get("primary") or "") for trial in trials}
    return metric_and_question(declared.pop())[0] if len(declared) == 1 else ""


def _seeds(wanted: TuneSettings, trials: Sequence[Trial]) -> tuple[int, ...]:
    word = parse_word(f"{SEED}={wanted.seed}")
    try:
        seeds = tuple(int(text.partition("=")[2]) for (text,) in grid([word]))
    except ValueError:
        raise InputError(f"{PLACE}.seed must list whole numbers, as 100,101, got {wanted.seed!r}") from None
    if both := sorted(set(seeds) & {trial.values["seed"] for trial in trials}):
        raise InputError(f"{PLACE}.seed: {listed(list(map(str, both)))} is a seed of the sweep, too: tune with others")
    return seeds


def _arms(
    begun: Sweep,
    wanted: TuneSettings,
    jobs: Sequence[Sequence[str]],
    searched: Sequence[Mapping[str, str]],
    trials: Sequence[Trial],
) -> list[Arm]:
    names = [(str(trial.values["init"]["name"]), str(trial.values["densify"]["name"])) for trial in trials]
    known = {name for init, densify in names for name in (densify, f"{init}-{densify}")}
    if unknown := next((name for name in wanted.ranges if name not in known), None):
        raise InputError(
            f"{PLACE}.ranges.{unknown} is no arm of the sweep{closest(unknown, known)} (there are: "
            f"{', '.join(sorted({densify for _, densify in names}))})"
        )
    arms = []
    for pair in dict.fromkeys(names):
        name = "-".join(pair)
        places = [place for place, own in enumerate(names) if own == pair]
        typed = {key: text for place in places for key, text in searched[place].items()}
        given = wanted.ranges.get(name, wanted.ranges.get(pair[1], typed or None))
        if given is None:
            raise InputError(
                f"{PLACE}.ranges say nothing of {pair[1]}: give what is tuned of it, or {pair[1]}: {{}} to leave it "
                "as it is, which each verdict will say"
            )
        texts = {str(key): str(value) for key, value in given.items()} | typed
        own = [tuple(word for word in jobs[place] if _key(word) not in REPLACED) for place in places]
        ranges = _ranges(begun, name, texts, [word for place in places for word in jobs[place]])
        first = _as_it_is(trials[places[0]].values, ranges) if ranges else None
        experiment = f"{trials[places[0]].values['name']}-tune-{name}"
        arms.append(Arm(name, experiment, texts, ranges, tuple(dict.fromkeys(own)), first))
    if not any(arm.ranges for arm in arms):
        raise InputError(f"{PLACE}.ranges name no setting of any arm: nothing is tuned")
    return arms


def _ranges(begun: Sweep, arm: str, texts: Mapping[str, str], words: Sequence[str]) -> Ranges:
    given = {_key(word) for word in words}
    found = {}
    for key, text in texts.items():
        bare = key.lstrip("+~")
        if bare.partition(".")[0] in (*MEASURED_ON, *REPLACED):
            raise InputError(f"{PLACE}.ranges: {key} is no setting of an arm, but of what all arms are measured by")
        if bare in given:
            raise InputError(f"{PLACE}.ranges: {key} of {arm} is tuned and given as well: leave one of them out")
        try:
            parse_word(f"{key}={text}")
        except InputError as error:
            raise InputError(f"{PLACE}.ranges of {arm}: {error}") from None
        (override,) = begun.parse([f"{key}={text}"])
        if not override.is_sweep_override():
            raise InputError(f"{PLACE}.ranges: {key}={text} is one value: give an interval or a list of values")
        found[key] = distribution(override)
    return dict(sorted(found.items()))


def _as_it_is(values: Mapping[str, Any], ranges: Ranges) -> Values | None:
    """The arm's own values of what is searched; None where the ranges lack one."""
    found: Values = {}
    for key, one in ranges.items():
        value: Any = values
        for part in key.lstrip("+~").split("."):
            value = value.get(part) if isinstance(value, Mapping) else None
        if (own := _in_range(value, one)) is None:
            return None
        found[key] = own
    return found


def _in_range(value: Any, one: Any) -> Any:
    if hasattr(one, "choices"):
        return next((choice for choice in one.choices if is_value(value, choice)), None)
    if isinstance(value, bool) or not isinstance(value, int | float) or not one.low <= value <= one.high:
        return None
    if isinstance(one.low, int):
        return value if isinstance(value, int) and (one.log or (value - one.low) % one.step == 0) else None
    return float(value) if float(text_of(float(value))) == value else None


def _key(word: str) -> str:
    return parse_word(word).get_key_element().lstrip("+~")
