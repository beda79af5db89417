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

import logging
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, islice, product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.override_parser.types import Override

from gsbench.analysis.results import group_by
from gsbench.app.sweep import Run, Sweep, searched_metric
from gsbench.config.command_words import check_makes_trials, grid_points
from gsbench.config.compose import Composer, Trial
from gsbench.config.overrides import bare_key, key_of, parse_word
from gsbench.config.schema import TUNE, TuneSettings
from gsbench.errors import GsbenchError, InputError
from gsbench.files import make_runs_folder, write_json
from gsbench.runs.configuration import flatten
from gsbench.runs.experiments import SearchPoint, TuningRecord, make_home
from gsbench.runs.layout import TUNING
from gsbench.settings import check_values
from gsbench.system.install import require_package
from gsbench.words import command, counted, listed

if TYPE_CHECKING:
    from optuna import Study
    from optuna.distributions import BaseDistribution
    from optuna.trial import Trial as Proposal

log = logging.getLogger(__name__)

# groups that say how all arms are run and judged
NOT_TUNED = ("scene", "eval", "launch", "tracking", "hydra")
# settings that have their own values in the trials of a point
RETUNED = ("seed", "name", "scene.validation", "eval.primary")
DIGITS = 4  # significant digits of a value, so that people can type it


def words_of_point(experiment: str) -> list[str]:
    """The words of a search's trials in their own ``experiment``, on validation views."""
    return [f"name={experiment}", "scene.validation=true", "eval.primary=null"]


def mean_of(trials: Sequence[Trial], metric: str) -> float | None:
    """The mean of a metric over ``trials``, from their files; None if one of them lacks it."""
    records = [trial.files.sound_record() for trial in trials]
    values = [record.metrics.get(metric) for record in records if record is not None]
    found = [value for value in values if value is not None]
    return statistics.fmean(found) if len(found) == len(trials) else None


@dataclass(frozen=True)
class ArmSearch:
    """The search for the values of an arm, in the experiment whose folder is ``home``.

    ``record`` says what is searched and by which metric, and gets the judged points. ``jobs`` are
    the arm's jobs in the sweep without the settings `RETUNED`. Optuna's ``study`` proposes points
    in the ``ranges`` and gets their results.
    """

    record: TuningRecord
    home: Path
    ranges: Mapping[str, BaseDistribution]
    jobs: Sequence[Sequence[str]]
    study: Study

    def jobs_of(self, values: Mapping[str, Any]) -> list[list[str]]:
        """The words of a point's trials."""
        of_point = [*words_of_point(self.home.name), *words_of_values(values)]
        seeds = self.record.seeds
        return [[*job, *of_point, f"seed={seed}"] for job, seed in product(self.jobs, seeds)]

    def judge(self, proposal: Proposal, trials: Sequence[Trial]) -> SearchPoint:
        """Judge a point by the mean of its trials; it failed if one of them lacks the metric."""
        from optuna.trial import TrialState

        mean = mean_of(trials, self.record.metric)
        state = TrialState.FAIL if mean is None else TrialState.COMPLETE
        self.study.tell(proposal, mean, state=state)
        settings = {
            key: float(_text(value)) if isinstance(value, float) else value
            for key, value in proposal.params.items()
        }
        self.record.points.append(point := SearchPoint(settings=settings, value=mean))
        return point


def tuned_jobs(
    sweep: Sweep,
    settings: Mapping[str, Any],
    jobs: list[list[str]],
    intervals: Sequence[Mapping[str, Override]],
    run: Run | None,
) -> tuple[list[list[str]], bool]:
    """Tune each arm in the ``intervals`` of its jobs; returns the jobs with the values found.

    In a dry run (``run`` is None) they may not be known yet: then the second value is False.
    Raises InputError for wrong ``settings`` (``hydra.sweeper.tune``) or intervals, and GsbenchError
    if no point of an arm could be judged.
    """
    tune = TuneSettings(**check_values(TuneSettings, settings, TUNE))
    if not tune.points or not any(intervals):
        return jobs, True
    if not sweep.config.launch.wait:
        raise InputError(f"{TUNE} learns from results, so launch.wait must be true")
    trials = sweep.trials(jobs)
    arms = [trial.folder.parent.name for trial in trials]
    searches = _plan(tune, trials, arms, jobs, intervals)
    if run is None:
        print(_describe(searches, arms))
    if not _search(sweep, searches, tune.at_once, run):
        print(
            f"then the trials of the sweep ({len(jobs)}) with the values found, which are not "
            "known yet"
        )
        return jobs, False
    best = {search.record.arm: _best_words(search) for search in searches}
    return [[*job, *best.get(arm, ())] for job, arm in zip(jobs, arms, strict=True)], True


def _search(
    composer: Composer, searches: Sequence[ArmSearch], at_once: int, run: Run | None
) -> bool:
    """Propose, train and judge the points of all arms side by side.

    A dry run judges only points whose trials are done already, and returns False at the first other
    point.
    """
    wanted, metric = searches[0].record.wanted, searches[0].record.metric
    for number in range(0, wanted, at_once):
        points = [
            (search, search.study.ask(dict(search.ranges)))
            for search in searches
            for _ in range(min(at_once, wanted - number))
        ]
        jobs = [search.jobs_of(proposal.params) for search, proposal in points]
        # Composed together, because the trials of a point share all but the seed.
        composed = iter(composer.trials(list(chain(*jobs))))
        trials = [list(islice(composed, len(of_point))) for of_point in jobs]
        missing = [trial for trial in chain(*trials) if mean_of([trial], metric) is None]
        if missing:
            if run is None:
                return False
            _write(searches)  # before training, so that the ranges were on record before any result
            run(missing)
        for (search, proposal), of_point in zip(points, trials, strict=True):
            point = search.judge(proposal, of_point)
            if missing:
                log.info(
                    "%s: point %d of %d: %s: %s %s",
                    search.home.name,
                    len(search.record.points),
                    wanted,
                    ", ".join(words_of_values(point.settings)),
                    metric,
                    "failed" if point.value is None else f"{point.value:.5g}",
                )
    if run is not None:
        _write(searches)
    return True


def _write(searches: Sequence[ArmSearch]) -> None:
    """Write the records of the searches to their experiments, where the report reads them."""
    for search in searches:
        make_runs_folder(search.home.parent)
        make_home(search.home)
        write_json(search.home / TUNING, search.record.to_json())


def _best_words(search: ArmSearch) -> list[str]:
    """The words of the best point of an arm. Raises GsbenchError if no point has the metric."""
    record, name = search.record, search.home.name
    if (best := record.best) is None:
        raise GsbenchError(
            f"{TUNE}: no point of {record.arm} has a {record.metric} "
            f"({command('status', name)} says why)"
        )
    words = words_of_values(best.settings)
    failed = sum(point.value is None for point in record.points)
    log.info(
        "search: best %s %.5g at %s (%s%s); gsbench report %s",
        record.metric,
        best.value,
        " ".join(words),
        counted(len(record.points), "point"),
        f", {failed} failed" if failed else "",
        name,
    )
    return words


def _describe(searches: Sequence[ArmSearch], arms: Sequence[str]) -> str:
    """The line in which a dry run describes the searches; other ``arms`` are not tuned."""
    first = searches[0].record
    tuned = [search.record.arm for search in searches]
    untuned = [arm for arm in dict.fromkeys(arms) if arm not in tuned]
    trainings = sum(len(search.jobs) for search in searches) * len(first.seeds) * first.wanted
    return (
        f"a search tunes first: {counted(first.wanted, 'point')} each for {listed(tuned)}, "
        f"by {first.metric} of validation views on {listed(first.scenes)} with "
        f"{counted(len(first.seeds), 'seed')}, {trainings} trainings"
        + (f"; not tuned: {listed(untuned)}" if untuned else "")
    )


# ---- the plan


def _plan(
    tune: TuneSettings,
    trials: Sequence[Trial],
    arms: Sequence[str],
    jobs: Sequence[Sequence[str]],
    intervals: Sequence[Mapping[str, Override]],
) -> list[ArmSearch]:
    """The search of each arm of a sweep that has intervals.

    Raises InputError for what cannot be searched.
    """
    require_package("optuna", "search", "a search")
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
    asked = _asked(tune, trials)
    rows = zip(arms, trials, jobs, intervals, strict=True)
    searches = []
    for arm, own in group_by(rows, lambda row: row[0]).items():
        found = {key: interval for *_, of_job in own for key, interval in of_job.items()}
        kept = [tuple(word for word in job if key_of(word) not in RETUNED) for _, _, job, _ in own]
        fixed = set(map(key_of, chain(*kept)))
        if both := next((key for key in sorted(found) if bare_key(key) in fixed), None):
            raise InputError(
                f"{both} of {arm} is searched in one grid and given in another: leave one of them "
                "out"
            )
        if not found:
            continue
        ranges = {key: distribution(found[key]) for key in sorted(found)}
        record = TuningRecord(
            **asked,
            arm=arm,
            ranges={key: str(found[key].input_line).partition("=")[2] for key in ranges},
            log=[key for key, searched in ranges.items() if getattr(searched, "log", False)],
            points=[],
        )
        home = trials[0].files.home
        study = _study(record, tune.at_once)
        settings = flatten(own[0][1].values)
        first = {key: settings.get(bare_key(key)) for key in ranges}
        if all(_is_in(first[key], searched) for key, searched in ranges.items()):
            study.enqueue_trial(first)
        place = home.with_name(f"{home.name}-tune-{arm}")
        searches.append(ArmSearch(record, place, ranges, list(dict.fromkeys(kept)), study))
    return searches


def _study(record: TuningRecord, at_once: int) -> Study:
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna.create_study(
        direction="maximize" if record.direction > 0 else "minimize",
        # Points that run together must know of each other, or one could be proposed twice.
        sampler=optuna.samplers.TPESampler(seed=0, constant_liar=at_once > 1),
    )


def _asked(tune: TuneSettings, trials: Sequence[Trial]) -> dict[str, Any]:
    """The facts that the records of all searches share.

    Raises InputError for a metric without a better direction.
    """
    metric, direction = searched_metric(trials[0].values)
    try:
        points = grid_points([parse_word(f"seed={tune.seed}")])
        seeds = [int(word.partition("=")[2]) for (word,) in points]
    except ValueError:
        raise InputError(
            f"{TUNE}.seed must list whole numbers, as 100,101, got {tune.seed!r}"
        ) from None
    if both := sorted(set(seeds) & {trial.values["seed"] for trial in trials}):
        raise InputError(
            f"{TUNE}.seed: {listed(list(map(str, both)))} is a seed of the sweep, too: tune with "
            "others"
        )
    return {
        "sweep": trials[0].files.home.name,
        "metric": metric,
        "direction": direction,
        "wanted": tune.points,
        "seeds": seeds,
        "scenes": list(dict.fromkeys(trial.values["scene"]["name"] for trial in trials)),
    }


# ---- values


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


def _is_in(value: Any, searched: Any) -> bool:
    """Return whether ``value`` lies in ``searched`` and rounding to `DIGITS` does not change it."""
    is_whole = isinstance(searched.low, int)
    if isinstance(value, bool) or not isinstance(value, int if is_whole else int | float):
        return False
    return searched.low <= value <= searched.high and (
        is_whole or float(_text(float(value))) == value
    )


def words_of_values(values: Mapping[str, Any]) -> list[str]:
    """The words of a command line that set ``values``, rounded to `DIGITS`."""
    return [f"{key}={_text(value)}" for key, value in values.items()]


def _text(value: Any) -> str:
    return f"{value:.{DIGITS}g}" if isinstance(value, float) else str(value)
