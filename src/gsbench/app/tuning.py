"""Tuning parity: before a sweep, each arm gets equally many search points, on validation views.

Intervals among the words of the sweep or in its grids say what is tuned, and for which arms. An arm
without intervals is not tuned. Each arm has its own search, whose points are trained in an
experiment of its own, so that no table shows them. The first point is the arm's own values, if they
lie in the intervals. The best point's values become words of the sweep's jobs.

Each search has an Optuna study in memory, whose proposals depend only on the results before them.
After a kill, the same proposals are made again from the first, and finished trials are found in
their folders.
"""

from __future__ import annotations

import importlib.util
import itertools
import logging
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from hydra.core.override_parser.types import Override

from gsbench.app.sweep import DEFAULT_METRIC, Run, Sweep, better_direction
from gsbench.config.command_words import (
    bare_key,
    check_makes_trials,
    grid_points,
    key_of,
    parse_word,
)
from gsbench.config.compose import Composer, Trial
from gsbench.config.schema import TUNE, TuneSettings
from gsbench.errors import GsbenchError, InputError
from gsbench.eval.facts import known_keys
from gsbench.files import checked_runs_folder, make_runs_folder, write_json
from gsbench.runs.experiments import SearchPoint, TuningRecord, make_home, metric_and_question
from gsbench.runs.layout import TUNING
from gsbench.runs.nested import flatten
from gsbench.settings import check_values
from gsbench.system.install import install_command
from gsbench.words import command, counted, did_you_mean, listed

if TYPE_CHECKING:
    from optuna import Study
    from optuna.distributions import BaseDistribution
    from optuna.trial import Trial as Proposal

log = logging.getLogger(__name__)

SEED = "seed"
# groups that say how all arms are run and judged
NOT_TUNED = ("scene", "eval", "launch", "tracking", "hydra")
# settings that have their own values in the trials of a point
RETUNED = (SEED, "name", "scene.validation", "eval.primary")
DIGITS = 4  # significant digits of a value, so that people can type it


@dataclass(frozen=True)
class ArmSearch:
    """The search for the values of an arm, in the experiment whose folder is ``home``.

    ``record`` says what is searched and by which metric, and gets the judged points. ``jobs`` are
    the arm's jobs in the sweep without the settings `RETUNED`. ``first`` are the arm's own values,
    None if they lie outside the ranges.
    """

    record: TuningRecord
    home: Path
    at_once: int
    ranges: Mapping[str, BaseDistribution]
    jobs: Sequence[Sequence[str]]
    first: Mapping[str, Any] | None

    @cached_property
    def study(self) -> Study:
        """Optuna's study, which proposes points and gets their results."""
        import optuna

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        sampler = optuna.samplers.TPESampler(seed=0, constant_liar=self.at_once > 1)
        direction: Literal["maximize", "minimize"] = "minimize"
        if self.record.direction > 0:
            direction = "maximize"
        study = optuna.create_study(direction=direction, sampler=sampler)
        if self.first is not None:
            study.enqueue_trial(dict(self.first))
        return study

    def propose(self) -> list[Proposal]:
        """The next points, ``at_once`` at most; none once all are judged."""
        count = min(self.at_once, self.record.wanted - len(self.record.points))
        return [self.study.ask(dict(self.ranges)) for _ in range(count)]

    def jobs_of(self, values: Mapping[str, Any]) -> list[list[str]]:
        """The words of a point's trials."""
        own = [
            f"name={self.home.name}",
            "scene.validation=true",
            "eval.primary=null",
            *words_of_values(values),
        ]
        seeds = [f"{SEED}={seed}" for seed in self.record.seeds]
        return [[*job, *own, seed] for job, seed in itertools.product(self.jobs, seeds)]

    def value_of(self, trial: Trial) -> float | None:
        """The metric of a trial, read from its files; None if it has none."""
        record = trial.files.sound_record()
        return None if record is None else record.metrics.get(self.record.metric)

    def judge(self, proposal: Proposal, trials: Sequence[Trial]) -> SearchPoint:
        """Judge a point by the mean of its trials; it failed if one of them lacks the metric."""
        from optuna.trial import TrialState

        values = [value for trial in trials if (value := self.value_of(trial)) is not None]
        mean = statistics.fmean(values) if len(values) == len(trials) else None
        state = TrialState.FAIL if mean is None else TrialState.COMPLETE
        self.study.tell(proposal, mean, state=state)
        settings = {key: _rounded(value) for key, value in proposal.params.items()}
        point = SearchPoint(settings=settings, value=mean)
        self.record.points.append(point)
        return point


def tuned_jobs(
    sweep: Sweep,
    settings: Mapping[str, Any],
    jobs: Sequence[Sequence[str]],
    intervals: Sequence[Mapping[str, Override]],
    run: Run | None,
) -> tuple[list[list[str]], bool]:
    """Tune each arm in the ``intervals`` of its jobs; returns the jobs with the values found.

    In a dry run (``run`` is None) they may not be known yet: then the second value is False.
    Raises InputError for wrong ``settings`` (``hydra.sweeper.tune``) or intervals, and GsbenchError
    if no point of an arm could be judged.
    """
    tune = TuneSettings(**check_values(TuneSettings, settings, TUNE))
    untuned = [list(job) for job in jobs]
    if not tune.points or not any(intervals):
        return untuned, True
    if not sweep.config.launch.wait:
        raise InputError(f"{TUNE} learns from results, so launch.wait must be true")
    trials = sweep.composer.trials(jobs)
    searches = _plan(tune, jobs, intervals, trials)
    tuned = {search.record.arm: search for search in searches if search.ranges}
    if run is None:
        print(_describe(searches))
    if not _search(sweep.composer, list(tuned.values()), run):
        print(
            f"then the trials of the sweep ({len(jobs)}) with the values found, which are not "
            "known yet"
        )
        return untuned, False
    best_words = {arm: _best_words(search) for arm, search in tuned.items()}
    arms = (trial.folder.parent.name for trial in trials)
    tuned_words = (best_words.get(arm, ()) for arm in arms)
    return [[*job, *own] for job, own in zip(jobs, tuned_words, strict=True)], True


def _search(composer: Composer, searches: Sequence[ArmSearch], run: Run | None) -> bool:
    """Propose, train and judge the points of all arms side by side.

    A dry run judges only points whose trials are done already, and returns False at the first other
    point.
    """
    while True:
        points: list[tuple[ArmSearch, Proposal, list[list[str]]]] = []
        for search in searches:
            points += [
                (search, proposal, search.jobs_of(proposal.params)) for proposal in search.propose()
            ]
        if not points:
            break
        # Composed together, because the trials of a point share all but the seed.
        composed = iter(composer.trials(list(itertools.chain(*(jobs for _, _, jobs in points)))))
        trials = [list(itertools.islice(composed, len(jobs))) for _, _, jobs in points]
        missing: list[Trial] = []
        for (search, _, _), own in zip(points, trials, strict=True):
            missing += [trial for trial in own if search.value_of(trial) is None]
        if missing:
            if run is None:
                return False
            _write(searches)  # before training, so that the ranges were on record before any result
            run(missing)
        for (search, proposal, _), own in zip(points, trials, strict=True):
            point, record = search.judge(proposal, own), search.record
            if missing:
                value = "failed" if point.value is None else f"{point.value:.5g}"
                title = f"{search.home.name}: point {len(record.points)} of {record.wanted}"
                settings = ", ".join(words_of_values(point.settings))
                log.info("%s: %s: %s %s", title, settings, record.metric, value)
    if run is not None:
        _write(searches)
    return True


def _write(searches: Sequence[ArmSearch]) -> None:
    """Write the records of the searches to their experiments, where the report reads them."""
    for search in searches:
        make_runs_folder(checked_runs_folder(str(search.home.parent)))
        make_home(search.home)
        write_json(search.home / TUNING, search.record.to_json())


def _best_words(search: ArmSearch) -> list[str]:
    """The words of the best point of an arm. Raises GsbenchError if no point has the metric."""
    record, best, name = search.record, search.record.best, search.home.name
    if best is None:
        raise GsbenchError(
            f"{TUNE}: no point of {record.arm} has a {record.metric} "
            f"({command('status', name)} says why)"
        )
    words = words_of_values(best.settings)
    failed = sum(point.value is None for point in record.points)
    count = counted(len(record.points), "point") + (f", {failed} failed" if failed else "")
    where = " ".join(words)
    log.info(
        "search: best %s %.5g at %s (%s); gsbench report %s",
        record.metric,
        best.value,
        where,
        count,
        name,
    )
    return words


def _describe(searches: Sequence[ArmSearch]) -> str:
    """The line in which a dry run describes the searches."""
    first = searches[0].record
    trials = {
        search.record.arm: len(search.jobs) * len(first.seeds)
        for search in searches
        if search.ranges
    }
    untuned = [search.record.arm for search in searches if not search.ranges]
    return (
        f"a search tunes first: {counted(first.wanted, 'point')} each for {listed(list(trials))}, "
        f"by {first.metric} of validation views on {listed(first.scenes)} with "
        f"{counted(len(first.seeds), 'seed')}, {sum(trials.values()) * first.wanted} trainings"
        + (f"; not tuned: {listed(untuned)}" if untuned else "")
    )


# ---- the plan


def _plan(
    tune: TuneSettings,
    jobs: Sequence[Sequence[str]],
    intervals: Sequence[Mapping[str, Override]],
    trials: Sequence[Trial],
) -> list[ArmSearch]:
    """The search of each arm of a sweep; for an arm that is not tuned it has no ranges.

    Raises InputError for what cannot be searched.
    """
    if importlib.util.find_spec("optuna") is None:
        raise InputError(f"a search needs Optuna: {install_command('search')}")
    homes = {trial.files.home for trial in trials}
    if len(homes) > 1:
        raise InputError(
            f"{TUNE}: all trials of the sweep need one name, got "
            f"{listed(sorted(h.name for h in homes))}"
        )
    if any(trial.values["scene"]["validation"] for trial in trials):
        raise InputError(
            f"{TUNE} searches on validation views by itself: leave scene.validation out"
        )
    metric, direction, seeds = _goal(tune, trials)
    (home,) = homes
    arms = [trial.folder.parent.name for trial in trials]
    searches = []
    for arm in dict.fromkeys(arms):
        indices = [index for index, name in enumerate(arms) if name == arm]
        found: dict[str, Override] = {}
        arm_jobs = []
        for i in indices:
            found |= intervals[i]
            arm_jobs.append(tuple(word for word in jobs[i] if key_of(word) not in RETUNED))
        arm_intervals = {key: found[key] for key in sorted(found)}
        fixed = set(map(key_of, itertools.chain(*arm_jobs)))
        if both := next((key for key in arm_intervals if bare_key(key) in fixed), None):
            raise InputError(
                f"{both} of {arm} is searched in one grid and given in another: leave one of them "
                "out"
            )
        ranges = {key: distribution(interval) for key, interval in arm_intervals.items()}
        first = _own_values(trials[indices[0]].values, ranges)
        record = TuningRecord(
            sweep=home.name,
            arm=arm,
            metric=metric,
            direction=direction,
            wanted=tune.points,
            seeds=seeds,
            scenes=list(dict.fromkeys(trial.values["scene"]["name"] for trial in trials)),
            ranges={
                key: str(interval.input_line).partition("=")[2]
                for key, interval in arm_intervals.items()
            },
            log=[key for key, values in ranges.items() if getattr(values, "log", False)],
            points=[],
        )
        own_home = home.with_name(f"{home.name}-tune-{arm}")
        searches.append(
            ArmSearch(record, own_home, tune.at_once, ranges, list(dict.fromkeys(arm_jobs)), first)
        )
    return searches


def _goal(tune: TuneSettings, trials: Sequence[Trial]) -> tuple[str, Literal[-1, 1], list[int]]:
    """The metric of all searches, its better direction, and the seeds of a point's trials.

    Raises InputError for an unknown metric, and for one without a better direction.
    """
    values = trials[0].values
    declared = {str(trial.values["eval"].get("primary") or "") for trial in trials}
    primary = metric_and_question(declared.pop())[0] if len(declared) == 1 else ""
    metric = tune.metric or primary or DEFAULT_METRIC
    known = (*known_keys(), *(values["eval"].get("extra") or ()))
    if metric not in known:
        raise InputError(
            f"{TUNE}.metric={metric}: there is no such metric{did_you_mean(metric, known)}"
        )
    direction = better_direction(metric, values, f"{TUNE}.metric")
    try:
        seeds = [
            int(word.partition("=")[2])
            for (word,) in grid_points([parse_word(f"{SEED}={tune.seed}")])
        ]
    except ValueError:
        raise InputError(
            f"{TUNE}.seed must list whole numbers, as 100,101, got {tune.seed!r}"
        ) from None
    if both := sorted(set(seeds) & {trial.values["seed"] for trial in trials}):
        raise InputError(
            f"{TUNE}.seed: {listed(list(map(str, both)))} is a seed of the sweep, too: tune with "
            "others"
        )
    return metric, direction, seeds


# ---- ranges


def distribution(override: Override) -> BaseDistribution:
    """The range of an interval, for Optuna.

    Raises InputError for a wrong interval or a setting that arms share.
    """
    from optuna.distributions import FloatDistribution, IntDistribution

    check_makes_trials(override)
    key = override.get_key_element()
    if bare_key(key).partition(".")[0] in (*NOT_TUNED, *RETUNED):
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


def _own_values(
    values: Mapping[str, Any], ranges: Mapping[str, BaseDistribution]
) -> dict[str, Any] | None:
    """The arm's own values of the searched settings; None if outside the ranges, or if none."""
    settings = flatten(values)
    own = {key: settings.get(bare_key(key)) for key in ranges}
    return (
        own if own and all(_is_in(own[key], searched) for key, searched in ranges.items()) else None
    )


def _is_in(value: Any, searched: Any) -> bool:
    """Return whether ``value`` lies in ``searched`` and rounding to `DIGITS` does not change it."""
    if (
        isinstance(value, bool)
        or not isinstance(value, int | float)
        or not searched.low <= value <= searched.high
    ):
        return False
    return (
        isinstance(value, int) if isinstance(searched.low, int) else _rounded(float(value)) == value
    )


def words_of_values(values: Mapping[str, Any]) -> list[str]:
    """The words of a command line that set ``values``."""
    return [
        f"{key}={f'{value:.{DIGITS}g}' if isinstance(value, float) else value}"
        for key, value in values.items()
    ]


def _rounded(value: Any) -> Any:
    """A value rounded as `words_of_values` writes it."""
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value
