"""Tuning parity: before a sweep's trials, each arm gets the same number of points of a search, on validation views.

What is tuned is given as intervals among the words of the sweep or in its grids, each for the arms that it is meant
for; an arm without any stays as it is. A search is the tuning of one arm. Each arm's points are trained in an
experiment of its own, so that no table holds them; the first is the arm as it is, where that lies in the intervals. The
best point's values become words of the sweep's jobs.

Each arm has a study of Optuna's in memory, whose proposals depend on the results before them alone. A sweep that was
killed asks it from the first point on again, and finds what was trained in the trials' folders.
"""

from __future__ import annotations

import importlib.util
import logging
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from hydra.core.override_parser.types import Override
from omegaconf import OmegaConf
from pydantic import NonNegativeInt, PositiveInt

from gsbench.app.grids import bare, grid, text_of
from gsbench.claims.stopping import facts_for
from gsbench.config.command_words import check_makes_trials, key_of, parse_word
from gsbench.config.compose import Trial
from gsbench.errors import GsbenchError, InputError
from gsbench.eval.facts import known_keys
from gsbench.files import checked_runs_folder, make_runs_folder, write_json
from gsbench.runs.declaration import metric_and_question
from gsbench.runs.experiments import Point, TuningRecord, make_home
from gsbench.runs.keys import flatten
from gsbench.runs.layout import TUNING
from gsbench.settings import check_settings
from gsbench.system.install import install_command
from gsbench.words import closest, counted, listed

if TYPE_CHECKING:
    from optuna import Study
    from optuna.distributions import BaseDistribution
    from optuna.trial import Trial as Proposal

    from gsbench.app.sweep import Sweep

log = logging.getLogger(__name__)

PLACE = "hydra.sweeper.tune"
DEFAULT_METRIC = "psnr"
DEFAULT_POINTS = 20
SEED = "seed"
MEASURED_ON = ("scene", "eval", "launch", "tracking", "hydra")  # groups that no arm may tune: they say how it is judged
REPLACED = (SEED, "name", "scene.validation", "eval.primary")  # words of a job that a point's trials have otherwise
DIGITS = 4  # significant digits of a value: a name for it that people can type


@dataclass(frozen=True)
class TuneSettings:
    """Settings of a tuning. ``points`` are those of each arm; 0: nothing is tuned, and intervals are left out.

    ``seed`` are the seeds of a point's trials, none of which the sweep may have.
    """

    points: NonNegativeInt = DEFAULT_POINTS
    at_once: PositiveInt = 1  # points of an arm that are chosen before the next result is known
    metric: str | None = None  # None: eval.primary, else PSNR
    seed: int | str = 100

    def __post_init__(self) -> None:
        check_settings(self, PLACE)


@dataclass(frozen=True)
class Goal:
    """The measure of a good point: the mean of ``metric`` over its trials with ``seeds``, times ``sign``."""

    metric: str
    sign: Literal[-1, 1]
    seeds: tuple[int, ...]


@dataclass(frozen=True)
class Search:
    """The search for the values of ``arm`` (INIT-DENSIFY), in the experiment whose folder is ``home``.

    ``jobs`` are the arm's of the sweep, without what a point's trials have otherwise; ``first`` are the arm's own
    values, if the ranges hold them. ``points`` are those that were judged.
    """

    arm: str
    home: Path
    settings: TuneSettings
    goal: Goal
    intervals: Mapping[str, Override]
    ranges: Mapping[str, BaseDistribution]
    jobs: Sequence[Sequence[str]]
    scenes: Sequence[str]
    first: Mapping[str, Any] | None
    points: list[Point] = field(default_factory=list)

    @cached_property
    def study(self) -> Study:
        """The study, which holds what was judged so far."""
        import optuna

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        sampler = optuna.samplers.TPESampler(seed=0, constant_liar=self.settings.at_once > 1)
        direction: Literal["maximize", "minimize"] = "maximize" if self.goal.sign > 0 else "minimize"
        study = optuna.create_study(direction=direction, sampler=sampler)
        if self.first is not None:
            study.enqueue_trial(dict(self.first))
        return study

    def propose(self) -> list[Proposal]:
        """The next points; none where all are judged."""
        count = min(self.settings.at_once, self.settings.points - len(self.points))
        return [self.study.ask(dict(self.ranges)) for _ in range(count)]

    def jobs_of(self, values: Mapping[str, Any]) -> list[list[str]]:
        """The words of a point's trials."""
        own = [f"name={self.home.name}", "scene.validation=true", "eval.primary=null", *words_of_values(values)]
        return [[*job, *own, f"{SEED}={seed}"] for job in self.jobs for seed in self.goal.seeds]

    def value_of(self, trial: Trial) -> float | None:
        """The metric of a trial, by its files."""
        record = trial.files.sound_record()
        return None if record is None else record.metrics.get(self.goal.metric)

    def judge(self, proposal: Proposal, trials: Sequence[Trial]) -> Point:
        """Judge a point by the mean of its trials; it has failed where one lacks the metric."""
        from optuna.trial import TrialState

        values = [value for trial in trials if (value := self.value_of(trial)) is not None]
        mean = statistics.fmean(values) if len(values) == len(trials) else None
        self.study.tell(proposal, mean, state=TrialState.FAIL if mean is None else TrialState.COMPLETE)
        point = Point(settings={key: _rounded(value) for key, value in proposal.params.items()}, value=mean)
        self.points.append(point)
        return point

    def record(self) -> TuningRecord:
        """The ranges that are searched, and the points that were found so far."""
        return TuningRecord(
            sweep=self.home.name.removesuffix(f"-tune-{self.arm}"),
            arm=self.arm,
            metric=self.goal.metric,
            direction=self.goal.sign,
            wanted=self.settings.points,
            seeds=list(self.goal.seeds),
            scenes=list(self.scenes),
            ranges={key: text_of(one) for key, one in self.intervals.items()},
            log=[key for key, one in self.ranges.items() if getattr(one, "log", False)],
            as_it_is=self.first is not None,
            points=self.points,
        )


def tuned_jobs(
    begun: Sweep, settings: Any, jobs: Sequence[Sequence[str]], intervals: Sequence[Mapping[str, Override]]
) -> list[list[str]]:
    """The jobs of a sweep with the values to which each arm is tuned first, in the ``intervals`` that each job has.

    Raises InputError for ``settings`` (``hydra.sweeper.tune``) and intervals that cannot be, and GsbenchError where no
    point of an arm could be judged.
    """
    wanted = TuneSettings(**OmegaConf.to_container(OmegaConf.create(settings)))  # type: ignore[arg-type]
    untuned = [list(job) for job in jobs]
    if not wanted.points or not any(intervals):
        return untuned
    if not begun.config.launch.wait:
        raise InputError(f"{PLACE} learns from results, so launch.wait must be true")
    trials = begun.trials(jobs)
    searches = _plan(wanted, jobs, intervals, trials)
    tuned = {search.arm: search for search in searches if search.ranges}
    if begun.task.look_only:
        print(_describe(searches))
    if not _search(begun, list(tuned.values())):
        print("what it will choose is not known yet: the arms are listed as they are")
        return untuned
    chosen = {arm: _best_words(search) for arm, search in tuned.items()}
    return [[*job, *chosen.get(trial.folder.parent.name, ())] for job, trial in zip(jobs, trials, strict=True)]


def _search(begun: Sweep, searches: Sequence[Search]) -> bool:
    """Propose, train and judge the points of all arms side by side; False where one is only looked at, and missing."""
    while asked := [(search, proposal) for search in searches for proposal in search.propose()]:
        words = [search.jobs_of(proposal.params) for search, proposal in asked]
        trials = begun.trials([job for jobs in words for job in jobs])
        of_points = [[trials.pop(0) for _ in jobs] for jobs in words]
        missing = [
            trial
            for (search, _), own in zip(asked, of_points, strict=True)
            for trial in own
            if search.value_of(trial) is None
        ]
        if missing and begun.task.look_only:
            return False
        if missing:
            _write(searches)  # what is searched stands there before it is trained
            begun.task.launch(missing)
        for (search, proposal), own in zip(asked, of_points, strict=True):
            point = search.judge(proposal, own)
            if missing:
                came = "failed" if point.value is None else f"{point.value:.5g}"
                where, number = ", ".join(words_of_values(point.settings)), len(search.points)
                place = f"{search.home.name}: point {number} of {search.settings.points}"
                log.info("%s: %s: %s %s", place, where, search.goal.metric, came)
    if not begun.task.look_only:
        _write(searches)
    return True


def _write(searches: Sequence[Search]) -> None:
    """Write what was found so far where the report looks for it."""
    for search in searches:
        make_runs_folder(checked_runs_folder(str(search.home.parent)))
        make_home(search.home)
        write_json(search.home / TUNING, search.record().to_json())


def _best_words(search: Search) -> list[str]:
    """The words of the best point of an arm."""
    best, name = search.record().best, search.home.name
    if best is None:
        raise GsbenchError(
            f"{PLACE}: no point of {search.arm} has a {search.goal.metric} (gsbench status {name} says why)"
        )
    words = words_of_values(best.settings)
    failed = sum(point.value is None for point in search.points)
    count = counted(len(search.points), "point") + (f", {failed} failed" if failed else "")
    where = " ".join(words)
    log.info("search: best %s %.5g at %s (%s); gsbench report %s", search.goal.metric, best.value, where, count, name)
    return words


def _describe(searches: Sequence[Search]) -> str:
    """A line that a dry run prints of the searches."""
    one = searches[0]
    trials = {search.arm: len(search.jobs) * len(one.goal.seeds) for search in searches if search.ranges}
    left = [search.arm for search in searches if not search.ranges]
    return (
        f"tunes first: {counted(one.settings.points, 'point')} each for {listed(list(trials))}, by {one.goal.metric} "
        f"of validation views on {listed(one.scenes)} with {counted(len(one.goal.seeds), 'seed')}, "
        f"{sum(trials.values()) * one.settings.points} trainings" + (f"; not tuned: {listed(left)}" if left else "")
    )


# ---- the plan


def _plan(
    wanted: TuneSettings,
    jobs: Sequence[Sequence[str]],
    intervals: Sequence[Mapping[str, Override]],
    trials: Sequence[Trial],
) -> list[Search]:
    """The search of each arm of a sweep, without ranges where the arm stays as it is.

    Raises InputError for what cannot be searched.
    """
    if importlib.util.find_spec("optuna") is None:
        raise InputError(f"a search needs Optuna: {install_command('search')}")
    homes = {trial.files.home for trial in trials}
    if len(homes) > 1:
        raise InputError(f"{PLACE}: all trials of the sweep need one name, got {listed(sorted(h.name for h in homes))}")
    if any(trial.values["scene"]["validation"] for trial in trials):
        raise InputError(f"{PLACE} searches on validation views by itself: leave scene.validation out")
    goal = _goal(wanted, trials)
    (home,) = homes
    names = [trial.folder.parent.name for trial in trials]
    searches = []
    for name in dict.fromkeys(names):
        places = [place for place, own in enumerate(names) if own == name]
        given = dict(sorted((key, one) for place in places for key, one in intervals[place].items()))
        own = [tuple(word for word in jobs[place] if key_of(word) not in REPLACED) for place in places]
        if both := next((key for key in given if any(key_of(word) == bare(key) for job in own for word in job)), None):
            raise InputError(f"{both} of {name} is searched in one grid and given in another: leave one of them out")
        ranges = {key: distribution(one) for key, one in given.items()}
        searches.append(
            Search(
                arm=name,
                home=home.with_name(f"{home.name}-tune-{name}"),
                settings=wanted,
                goal=goal,
                intervals=given,
                ranges=ranges,
                jobs=list(dict.fromkeys(own)),
                scenes=list(dict.fromkeys(trial.values["scene"]["name"] for trial in trials)),
                first=_own_values(trials[places[0]].values, ranges),
            )
        )
    return searches


def _goal(wanted: TuneSettings, trials: Sequence[Trial]) -> Goal:
    """Raises InputError for a metric that is not known, or of which it is not known whether more of it is better."""
    values = trials[0].values
    declared = {str(trial.values["eval"].get("primary") or "") for trial in trials}
    primary = metric_and_question(declared.pop())[0] if len(declared) == 1 else ""
    metric = wanted.metric or primary or DEFAULT_METRIC
    known = (*known_keys(), *(values["eval"].get("extra") or ()))
    if metric not in known:
        raise InputError(f"{PLACE}.metric={metric}: there is no such metric{closest(metric, known)}")
    sign = facts_for(metric, values).direction
    if not sign:
        raise InputError(f"{PLACE}.metric={metric}: whether more or less of it is better is not known")
    try:
        seeds = tuple(int(text.partition("=")[2]) for (text,) in grid([parse_word(f"{SEED}={wanted.seed}")]))
    except ValueError:
        raise InputError(f"{PLACE}.seed must list whole numbers, as 100,101, got {wanted.seed!r}") from None
    if both := sorted(set(seeds) & {trial.values["seed"] for trial in trials}):
        raise InputError(f"{PLACE}.seed: {listed(list(map(str, both)))} is a seed of the sweep, too: tune with others")
    return Goal(metric, 1 if sign > 0 else -1, seeds)


# ---- ranges


def distribution(override: Override) -> BaseDistribution:
    """Return the range of an interval's values; raises InputError for what makes no other trial of an arm."""
    from optuna.distributions import FloatDistribution, IntDistribution

    check_makes_trials(override)
    key = override.get_key_element()
    if bare(key).partition(".")[0] in (*MEASURED_ON, *REPLACED):
        raise InputError(f"{key} belongs to what all arms share, not to one arm: give it a value")
    sweep: Any = override.value()
    low, high, log_scale = sweep.start, sweep.end, "log" in sweep.tags
    try:
        if not -math.inf < low < high < math.inf:
            raise ValueError("an interval goes from a number to a larger one")
        if log_scale and low <= 0:
            raise ValueError("on a logarithmic scale an interval begins above 0")
        if "int" in sweep.tags:
            if not float(low).is_integer() or not float(high).is_integer():
                raise ValueError("whole numbers lie between whole numbers")
            return IntDistribution(int(low), int(high), log=log_scale)
        return FloatDistribution(float(low), float(high), log=log_scale)
    except ValueError as error:
        raise InputError(f"{override.input_line}: {error}") from error


def _own_values(values: Mapping[str, Any], ranges: Mapping[str, BaseDistribution]) -> dict[str, Any] | None:
    """The arm's own values of what is searched; None where the ranges lack one, or nothing is searched."""
    settings = flatten(values)
    found = {key: settings.get(bare(key)) for key in ranges}
    return found if found and all(_is_in(found[key], one) for key, one in ranges.items()) else None


def _is_in(value: Any, one: Any) -> bool:
    """Return whether the range ``one`` has a value, as a point's trials would have it."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not one.low <= value <= one.high:
        return False
    return isinstance(value, int) if isinstance(one.low, int) else _rounded(float(value)) == value


def words_of_values(values: Mapping[str, Any]) -> list[str]:
    """A point as words of a command line."""
    return [f"{key}={f'{value:.{DIGITS}g}' if isinstance(value, float) else value}" for key, value in values.items()]


def _rounded(value: Any) -> Any:
    """A value of a point as its trials have it."""
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value
