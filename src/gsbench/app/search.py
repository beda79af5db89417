"""A search by Optuna: which values of the settings make a metric best, learned from the trials so far.

A point of the search is a choice of values. It is judged once all its seeds are done, by the mean of the metric over
them; if one fails, the point has failed (`gsbench.app.study`).
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext
from omegaconf import DictConfig
from pydantic import PositiveInt

from gsbench.app.study import Goal, Ranges, Study, arm_of, best_words, distribution, lowest, sign_of, words_of_values
from gsbench.app.task import Task, grid, launch_trials, trials_of_jobs
from gsbench.config.compose import explained
from gsbench.errors import InputError
from gsbench.eval.facts import find
from gsbench.files import checked_runs_folder, make_runs_folder
from gsbench.launch.trial import Trial
from gsbench.runs.experiments import make_home
from gsbench.runs.hashing import config_hash, sha256_of
from gsbench.runs.layout import SEARCH
from gsbench.settings import check_settings
from gsbench.system.locks import hold
from gsbench.words import counted

log = logging.getLogger(__name__)

PLACE = "hydra.sweeper"
SEED = "seed"
GROUPS_OF_ARMS = {"init", "densify"}  # which of them is best may be what is searched
ALIASES = {"trials": "n_trials", "at_once": "n_jobs"}  # other names of settings


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
        check_settings(self, PLACE)
        sign_of(self.metric, self.direction, PLACE)

    @classmethod
    def given(cls, values: Mapping[str, Any]) -> SearchSettings:
        """The settings below ``hydra.sweeper``; raises InputError where one has a value by each of its two names."""
        values = dict(values)
        for alias, name in ALIASES.items():
            value = values.pop(alias, None)
            if value is None:
                continue
            if values.get(name) not in (None, value, getattr(cls, name)):
                raise InputError(f"{PLACE}.{alias} is {name} by another name, and both are given: leave one out")
            values[name] = value
        return cls(**values)

    @property
    def goal(self) -> Goal:
        sign = sign_of(self.metric, self.direction, PLACE)
        return Goal(self.metric, sign, self.n_trials, self.n_jobs, self.seed)


@dataclass(frozen=True)
class Space:
    """Space of a search: the words that stay, the distribution of each searched key, and the seeds."""

    fixed: tuple[str, ...]
    searched: Ranges
    seeds: tuple[str, ...]

    def jobs(self, values: Mapping[str, Any]) -> list[list[str]]:
        """The words of a point's trials, one for each seed."""
        return [[*self.fixed, *words_of_values(values), *([seed] if seed else [])] for seed in self.seeds]


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
    first = trials_of_jobs(context, master, space.jobs(lowest(space.searched)))
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
    home = first[0].files.home
    make_home(home)
    study = Study(
        home,
        _identity(first[0], wanted, space),
        wanted.goal,
        space.searched,
        seeds=len(space.seeds),
        arm="" if GROUPS_OF_ARMS & space.searched.keys() else arm_of(first[0]),
        unseen=unseen,
    )
    with hold(home / f".{SEARCH}.lock", "the search"):
        while batch := study.next_points():
            trials = []
            for number, values in batch.items():
                trials += trials_of_jobs(context, master, space.jobs(values), number * len(space.seeds))
            launch_trials(task, master, launcher, trials)
            for place, number in enumerate(batch):
                study.judge(number, trials[place * len(space.seeds) :][: len(space.seeds)])
            study.write_record()
        record = study.write_record()
    log.info("%s", best_words(record, home.name))


def read_space(overrides: Sequence[Override]) -> Space:
    """The space that the words of a sweep span: intervals, ranges and lists of values are searched, seeds repeated."""
    fixed: list[str] = []
    searched = {}
    seeds: tuple[str, ...] = ("",)
    for override in {given.get_key_element(): given for given in overrides}.values():  # of two the later counts
        key = override.get_key_element()
        if not override.is_sweep_override():
            fixed += grid([override])[0]
        elif key == SEED and override.is_discrete_sweep():
            seeds = tuple(words[0] for words in grid([override]))
        else:
            searched[key] = distribution(override)
    if not searched:
        raise InputError(
            "nothing is searched: give an interval, as 'densify.volume_threshold=tag(log, interval(1e-3, 1))'"
        )
    return Space(tuple(fixed), dict(sorted(searched.items())), seeds)


def _identity(trial: Trial, wanted: SearchSettings, space: Space) -> str:
    """A study's name: searches that differ in anything that has a part in a result do not learn from each other."""
    searched = {key: repr(one) for key, one in space.searched.items()}
    own = [wanted.direction] if find(wanted.metric) is None else []
    return sha256_of([config_hash(trial.values), wanted.metric, searched, list(space.seeds), *own])[:16]
