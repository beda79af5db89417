"""A search by Optuna: which values of the settings make a metric best, learned from the trials so far.

A point of the search is a choice of values. It is judged once all its seeds are done, by the mean of the metric over
them; if one fails, the point has failed. The study lies in a journal beside the experiment's trials, and what a point
is worth is read from these, so a search that was killed goes on where it stopped and trains nothing twice.
"""

from __future__ import annotations

import logging
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import IntervalSweep, Override, RangeSweep
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext
from omegaconf import DictConfig
from pydantic import PositiveInt

from gsbench.app.task import Task, grid, launch_trials, trials_of_jobs
from gsbench.config.command_words import check_makes_trials
from gsbench.config.compose import explained
from gsbench.errors import InputError
from gsbench.eval.facts import find, known_keys
from gsbench.files import checked_runs_folder, make_runs_folder, write_json
from gsbench.launch.trial import Trial
from gsbench.parsing import DamagedError
from gsbench.runs.hashing import config_hash, sha256_of
from gsbench.runs.inputs import read_results
from gsbench.runs.layout import SEARCH, SEARCH_JOURNAL
from gsbench.runs.search_record import Point, SearchRecord
from gsbench.settings import check_settings
from gsbench.system.install import install_command
from gsbench.system.locks import hold
from gsbench.words import closest, counted

if TYPE_CHECKING:
    from optuna import Study
    from optuna.distributions import BaseDistribution

log = logging.getLogger(__name__)

DIGITS = 4  # significant digits of a value: a name for it that people can type
SEED = "seed"
ALIASES = {"trials": "n_trials", "at_once": "n_jobs"}  # other names of settings
DIRECTIONS = {1: "maximize", -1: "minimize"}


@dataclass(frozen=True)
class SearchSettings:
    """Settings of a search, by the names of Hydra's own plug-in for Optuna where that has them.

    ``metric`` is made best; ``n_trials`` counts points, each trained with every seed.
    """

    metric: str = "psnr"
    direction: Literal["maximize", "minimize"] | None = None  # None: that in which the metric is better
    n_trials: PositiveInt = 20
    n_jobs: PositiveInt = 1  # points that are chosen before the next result is known
    seed: int = 0  # of the sampler

    def __post_init__(self) -> None:
        check_settings(self, "hydra.sweeper")
        facts = find(self.metric)
        if facts is None and self.direction is None:
            raise InputError(
                f"hydra.sweeper.metric={self.metric} is no metric whose direction is known"
                f"{closest(self.metric, known_keys())} (choose: {', '.join(known_keys())}; for a metric of your own "
                "give hydra.sweeper.direction, too)"
            )
        if facts is not None and self.direction not in (None, DIRECTIONS.get(facts.direction)):
            raise InputError(
                f"hydra.sweeper.direction={self.direction}: {facts.label} is better the other way; leave direction out"
            )

    @classmethod
    def given(cls, values: Mapping[str, Any]) -> SearchSettings:
        """The settings below ``hydra.sweeper``; raises InputError where one has a value by each of its two names."""
        values = dict(values)
        for alias, name in ALIASES.items():
            value = values.pop(alias, None)
            if value is None:
                continue
            if values.get(name) not in (None, value, getattr(cls, name)):
                raise InputError(f"hydra.sweeper.{alias} is {name} by another name, and both are given: leave one out")
            values[name] = value
        return cls(**values)

    @property
    def sign(self) -> int:
        """The direction as a number: +1 where more is better, -1 where less is."""
        facts = find(self.metric)
        given = next((sign for sign, name in DIRECTIONS.items() if name == self.direction), 0)
        return given or (facts.direction if facts else 0)


@dataclass(frozen=True)
class Space:
    """Space of a search: the words that stay, the distribution of each searched key, and the seeds."""

    fixed: tuple[str, ...]
    searched: Mapping[str, BaseDistribution]
    seeds: tuple[str, ...]

    def jobs(self, values: Mapping[str, Any]) -> list[list[str]]:
        """The words of a point's trials, one for each seed."""
        point = [f"{key}={_text(value)}" for key, value in values.items()]
        return [[*self.fixed, *point, *([seed] if seed else [])] for seed in self.seeds]


def search(
    task: Task,
    context: HydraContext,
    master: DictConfig,
    launcher: Launcher,
    settings: Mapping[str, Any],
    words: Sequence[str],
) -> None:
    """Search until the study has as many points as ``settings`` ask for."""
    if task.grids:
        raise InputError("hydra.sweeper.grids lists what to train, so leave hydra/sweeper=optuna out, or the grids")
    wanted = SearchSettings.given(settings)
    with explained(words):
        space = read_space(OverridesParser.create(context.config_loader).parse_overrides(list(words)))
    lowest = {key: _lowest(distribution) for key, distribution in space.searched.items()}
    first = trials_of_jobs(context, master, space.jobs(lowest))
    unseen = all(trial.values["scene"]["validation"] for trial in first)
    if not unseen:
        log.warning(
            "this search is judged by the test views, so that they choose its best and cannot test it any more: "
            "scene.validation=true puts them away and judges by other views"
        )
    if task.look_only:
        seeds = counted(len(space.seeds), "seed")
        points = counted(wanted.n_trials, "point")
        print(f"a search of {points} with {seeds} each; the point of the lowest values would be")
        task.launch(first)
    make_runs_folder(checked_runs_folder(first[0].values["runs"]))
    home = first[0].paths.home
    home.mkdir(exist_ok=True)
    with hold(home / f".{SEARCH}.lock", "the search"):
        study = _open(home, wanted, _identity(first[0], wanted, space))
        while batch := _next_points(study, wanted, space):
            trials = []
            for number, values in batch.items():
                trials += trials_of_jobs(context, master, space.jobs(values), number * len(space.seeds))
            launch_trials(task, master, launcher, trials)
            for place, number in enumerate(batch):
                _tell(study, number, trials[place * len(space.seeds) :][: len(space.seeds)], wanted)
            write_json(home / SEARCH, _record(study, wanted, space, unseen).to_json())
        write_json(home / SEARCH, _record(study, wanted, space, unseen).to_json())
    _say_best(study, wanted, home.name)


def read_space(overrides: Sequence[Override]) -> Space:
    """The space that the words of a sweep span: intervals, ranges and lists of values are searched, seeds repeated."""
    fixed: list[str] = []
    searched: dict[str, BaseDistribution] = {}
    seeds: tuple[str, ...] = ("",)
    for override in {given.get_key_element(): given for given in overrides}.values():  # of two the later counts
        key = override.get_key_element()
        if not override.is_sweep_override():
            fixed += grid([override])[0]
        elif key == SEED and override.is_discrete_sweep():
            seeds = tuple(words[0] for words in grid([override]))
        else:
            check_makes_trials(override)
            searched[key] = _distribution(override)
    if not searched:
        raise InputError(
            "nothing is searched: give an interval, as 'densify.volume_threshold=tag(log, interval(1e-3, 1))'"
        )
    return Space(tuple(fixed), dict(sorted(searched.items())), seeds)


def _distribution(override: Override) -> BaseDistribution:
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    sweep: Any = override.value()
    try:
        if isinstance(sweep, IntervalSweep):
            low, high = sweep.start, sweep.end
            assert low is not None
            assert high is not None
            log_scale = "log" in sweep.tags
            if isinstance(sweep.start, int) and isinstance(sweep.end, int) and "int" in sweep.tags:
                return IntDistribution(sweep.start, sweep.end, log=log_scale)
            return FloatDistribution(float(low), float(high), log=log_scale)
        if isinstance(sweep, RangeSweep) and not isinstance(sweep.step, float):
            values = [int(str(value)) for value in override.sweep_iterator()]
            return IntDistribution(values[0], values[-1], step=max(1, int(sweep.step)))
        choices = list(dict.fromkeys(word.partition("=")[2] for (word,) in grid([override])))
        return CategoricalDistribution(choices)
    except (ValueError, IndexError) as error:
        raise InputError(f"{override.input_line}: {error}") from error


def _lowest(distribution: Any) -> Any:
    return distribution.choices[0] if hasattr(distribution, "choices") else distribution.low


def _text(value: Any) -> str:
    return f"{value:.{DIGITS}g}" if isinstance(value, float) else str(value)


def _identity(trial: Trial, wanted: SearchSettings, space: Space) -> str:
    """A study's name: searches that differ in anything that has a part in a result do not learn from each other."""
    searched = {key: repr(distribution) for key, distribution in space.searched.items()}
    own = [wanted.direction] if find(wanted.metric) is None else []
    return sha256_of([config_hash(trial.values), wanted.metric, searched, list(space.seeds), *own])[:16]


def _open(home: Path, wanted: SearchSettings, name: str) -> Study:
    try:
        import optuna
    except ImportError:
        raise InputError(f"hydra/sweeper=optuna needs Optuna: {install_command('search')}") from None
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    direction = optuna.study.StudyDirection.MAXIMIZE if wanted.sign > 0 else optuna.study.StudyDirection.MINIMIZE
    storage = JournalStorage(JournalFileBackend(str(home / SEARCH_JOURNAL)))
    return optuna.create_study(study_name=name, storage=storage, direction=direction, load_if_exists=True)


def _next_points(study: Study, wanted: SearchSettings, space: Space) -> dict[int, dict[str, Any]]:
    """Values by the number of the point: those that a killed search left unjudged, else the sampler's next."""
    from optuna.samplers import TPESampler
    from optuna.trial import TrialState

    known = study.get_trials(deepcopy=False)
    begun = {trial.number: trial.params for trial in known if trial.state == TrialState.RUNNING}
    left = {number: values for number, values in begun.items() if set(values) == set(space.searched)}
    for number in begun.keys() - left.keys():  # killed between its first value and its last
        study.tell(number, state=TrialState.FAIL)
    if left:
        return left
    points: dict[int, dict[str, Any]] = {}
    while len(known) + len(points) < wanted.n_trials and len(points) < wanted.n_jobs:
        number = len(known) + len(points)
        # A sampler for each point: what it proposes depends on the results, not on when the search was killed.
        study.sampler = TPESampler(seed=wanted.seed + number, constant_liar=wanted.n_jobs > 1)
        asked = study.ask(dict(space.searched))
        points[asked.number] = asked.params
    return points


def _tell(study: Study, number: int, trials: Sequence[Trial], wanted: SearchSettings) -> None:
    """Judge a point by the files of its trials."""
    from optuna.trial import TrialState

    folders = [trial.folder for trial in trials]
    found = [_metric_of(folder, wanted.metric) for folder in folders]
    values = [value for value in found if value is not None]
    if len(values) < len(found):
        study.tell(number, state=TrialState.FAIL)
    else:
        study.tell(number, statistics.fmean(values))
    done = study.get_trials(deepcopy=False)[number]
    where = ", ".join(f"{key}={_text(value)}" for key, value in done.params.items())
    came = f"{wanted.metric} {done.value:.5g}" if done.value is not None else f"failed, without {wanted.metric}"
    log.info("search: point %d of %d: %s: %s", number + 1, wanted.n_trials, where, came)


def _metric_of(folder: Path, metric: str) -> float | None:
    try:
        return read_results(folder)[0].metrics.get(metric)
    except (FileNotFoundError, DamagedError):
        return None


def _record(study: Study, wanted: SearchSettings, space: Space, unseen: bool) -> SearchRecord:
    """The record that the report shows; ``unseen`` says that no point saw a test view."""
    from optuna.distributions import FloatDistribution, IntDistribution

    states: dict[str, Literal["done", "failed"]] = {"COMPLETE": "done", "FAIL": "failed"}
    return SearchRecord(
        metric=wanted.metric,
        direction=1 if wanted.sign > 0 else -1,
        wanted=wanted.n_trials,
        seeds=len(space.seeds),
        validation=unseen,
        log=[k for k, d in space.searched.items() if isinstance(d, FloatDistribution | IntDistribution) and d.log],
        points=[
            Point(
                number=trial.number,
                state=states.get(trial.state.name, "unfinished"),
                settings={key: _shown(value) for key, value in trial.params.items()},
                value=trial.value,
            )
            for trial in study.get_trials(deepcopy=False)
        ],
    )


def _shown(value: Any) -> Any:
    return float(_text(value)) if isinstance(value, float) else value


def _say_best(study: Study, wanted: SearchSettings, name: str) -> None:
    points = study.get_trials(deepcopy=False)
    failed = sum(point.value is None for point in points)
    count = counted(len(points), "point") + (f", {failed} failed" if failed else "")
    if failed == len(points):
        log.info("search: %s; see gsbench status %s", count, name)
        return
    best = study.best_trial
    where = " ".join(f"{key}={_text(value)}" for key, value in best.params.items())
    log.info("search: best %s %.5g at %s (%s); gsbench report %s", wanted.metric, best.value, where, count, name)
