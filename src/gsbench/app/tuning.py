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

import itertools
import logging
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from hydra.core.override_parser.types import Override

from gsbench.analysis.results import group_by
from gsbench.app.arm_search import (
    RETUNED,
    SEED,
    ArmSearch,
    distribution,
    own_values,
    words_of_values,
)
from gsbench.app.sweep import Run, Sweep, better_direction
from gsbench.config.command_words import grid_points
from gsbench.config.compose import Composer, Trial
from gsbench.config.overrides import bare_key, key_of, parse_word
from gsbench.config.schema import TUNE, TuneSettings
from gsbench.errors import GsbenchError, InputError
from gsbench.eval.facts import known_keys
from gsbench.files import checked_runs_folder, make_runs_folder, write_json
from gsbench.runs.experiments import (
    DEFAULT_METRIC,
    TuningRecord,
    make_home,
    metric_and_question,
)
from gsbench.runs.layout import TUNING
from gsbench.settings import check_values
from gsbench.system.install import require_package
from gsbench.words import command, counted, did_you_mean, listed

if TYPE_CHECKING:
    from optuna.trial import Trial as Proposal

log = logging.getLogger(__name__)


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
    return [[*job, *best] for job, best in zip(jobs, tuned_words, strict=True)], True


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
        for (search, _, _), of_point in zip(points, trials, strict=True):
            missing += [trial for trial in of_point if search.value_of(trial) is None]
        if missing:
            if run is None:
                return False
            _write(searches)  # before training, so that the ranges were on record before any result
            run(missing)
        for (search, proposal, _), of_point in zip(points, trials, strict=True):
            point, record = search.judge(proposal, of_point), search.record
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
    by_arm = group_by(
        zip(trials, jobs, intervals, strict=True), lambda job: job[0].folder.parent.name
    )
    return [_arm_search(asked, tune.at_once, of_arm) for of_arm in by_arm.values()]


def _arm_search(
    record: Callable[..., TuningRecord],
    at_once: int,
    jobs: Sequence[tuple[Trial, Sequence[str], Mapping[str, Override]]],
) -> ArmSearch:
    """The search of an arm with these ``jobs``: each a trial, its words, and its intervals.

    ``record`` makes its record from what is its own.
    """
    first = jobs[0][0]
    home, arm = first.files.home, first.folder.parent.name
    found: dict[str, Override] = {}
    for _, _, of_job in jobs:
        found |= of_job
    intervals = {key: found[key] for key in sorted(found)}
    kept = [tuple(word for word in words if key_of(word) not in RETUNED) for _, words, _ in jobs]
    fixed = set(map(key_of, itertools.chain(*kept)))
    if both := next((key for key in intervals if bare_key(key) in fixed), None):
        raise InputError(
            f"{both} of {arm} is searched in one grid and given in another: leave one of them out"
        )
    ranges = {key: distribution(interval) for key, interval in intervals.items()}
    texts = {key: str(one.input_line).partition("=")[2] for key, one in intervals.items()}
    log_scaled = [key for key, values in ranges.items() if getattr(values, "log", False)]
    return ArmSearch(
        record(arm=arm, ranges=texts, log=log_scaled, points=[]),
        home.with_name(f"{home.name}-tune-{arm}"),
        at_once,
        ranges,
        list(dict.fromkeys(kept)),
        own_values(first.values, ranges),
    )


def _asked(tune: TuneSettings, trials: Sequence[Trial]) -> Callable[..., TuningRecord]:
    """The record of the searches, without arms and their ranges.

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
    return partial(
        TuningRecord,
        sweep=trials[0].files.home.name,
        metric=metric,
        direction=direction,
        wanted=tune.points,
        seeds=seeds,
        scenes=list(dict.fromkeys(trial.values["scene"]["name"] for trial in trials)),
    )
