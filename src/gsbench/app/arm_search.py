"""Searches on validation views: for the values of one arm, and by another sweeper of Hydra's."""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from hydra.core.override_parser.types import Override

from gsbench.config.command_words import check_makes_trials
from gsbench.config.compose import Trial
from gsbench.config.overrides import bare_key
from gsbench.errors import InputError
from gsbench.runs.experiments import DEFAULT_METRIC, SearchPoint, TuningRecord
from gsbench.runs.nested import flatten

if TYPE_CHECKING:
    from optuna import Study
    from optuna.distributions import BaseDistribution
    from optuna.trial import Trial as Proposal

import logging
import shlex
from dataclasses import field

from omegaconf import DictConfig, OmegaConf

from gsbench.app.sweep import BASIC, Sweep, better_direction
from gsbench.config.command_words import grid_points
from gsbench.config.overrides import is_sweep, key_of, parse_word
from gsbench.errors import GsbenchError
from gsbench.runs.experiments import metric_and_question
from gsbench.words import counted

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
        of_point = [*words_of_point(self.home.name), *words_of_values(values)]
        seeds = [f"{SEED}={seed}" for seed in self.record.seeds]
        return [[*job, *of_point, seed] for job, seed in itertools.product(self.jobs, seeds)]

    def value_of(self, trial: Trial) -> float | None:
        """The metric of a trial, read from its files; None if it has none."""
        return measured(trial, self.record.metric)

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


def words_of_point(experiment: str) -> list[str]:
    """The words of a search's trials in their own ``experiment``, on validation views."""
    return [f"name={experiment}", "scene.validation=true", "eval.primary=null"]


def measured(trial: Trial, metric: str) -> float | None:
    """The ``metric`` of a trial, read from its files; None if it has none."""
    record = trial.files.sound_record()
    return None if record is None else record.metrics.get(metric)


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


def own_values(
    values: Mapping[str, Any], ranges: Mapping[str, BaseDistribution]
) -> dict[str, Any] | None:
    """The arm's own values of the searched settings; None if outside the ranges, or if none."""
    settings = flatten(values)
    present = {key: settings.get(bare_key(key)) for key in ranges}
    return (
        present
        if present and all(_is_in(present[key], searched) for key, searched in ranges.items())
        else None
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


log = logging.getLogger(__name__)


# ---- a search by another sweeper, which gets values of validation views and asks no question


@dataclass
class Goal:
    """The space that another sweeper searches, and the trials of its points, which lie in ``home``.

    A point's value is the mean of a metric over the ``seeds`` (words; none: the job's own seed) on
    validation views. ``sign`` says what the sweeper looks for: the largest value (1) or the least
    (-1). A metric whose better ``direction`` is the other one is negated.
    """

    home: str
    metric: str
    direction: int
    sign: int
    seeds: tuple[str, ...] = ()
    values: dict[tuple[str, ...], float] = field(default_factory=dict)  # of the jobs

    def jobs_of(self, job: Sequence[str]) -> list[list[str]]:
        """The words of a point's trials."""
        words = [*job, *words_of_point(self.home)]
        return [[*words, seed] for seed in self.seeds] or [words]

    def value(self, job: Sequence[str], trials: Sequence[Trial]) -> float:
        """The value of a job with its ``trials``, which are done.

        Raises GsbenchError if one lacks the metric.
        """
        values = [measured(trial, self.metric) for trial in trials]
        found = [value for value in values if value is not None]
        if len(found) < len(trials):
            raise GsbenchError(
                f"{trials[0].files.label} has no {self.metric}, which the sweeper needs"
            )
        value = statistics.fmean(found) * self.direction * self.sign
        self.values[tuple(job)] = value
        return value

    def best_line(self) -> str:
        """The best values, with the command that trains them; "" if no point has a value."""
        if not self.values:
            return ""
        best = max(self.values, key=lambda job: self.values[job] * self.sign)
        swept = [word for word in best if not all(word in job for job in self.values)]
        value = self.values[best] * self.direction * self.sign
        seeds = ",".join(word.partition("=")[2] for word in self.seeds)
        words = [*best, *[f"seed={seeds}"] * bool(seeds)]
        words = ["-m", *words] if len(self.seeds) > 1 else words
        return (
            f"best: {' '.join(swept) or 'the only point'}, {self.metric} {value:.4g} of validation "
            f"views ({counted(max(1, len(self.seeds)), 'seed')}, in {self.home}); to train it: "
            f"gsbench {shlex.join(words)}"
        )


def goal_of(sweep: Sweep) -> Goal | None:
    """The space that the chosen sweeper searches; None for Hydra's grid."""
    if sweep.other_sweeper == BASIC:
        return None
    node = sweep.config.hydra.sweeper
    lists = {
        bare_key(str(key)): f"{key}={value}" for key, value in (node.get("params") or {}).items()
    }
    lists |= {key_of(word): word for word in sweep.words if is_sweep(word)}
    seeds = grid_points([parse_word(lists["seed"])]) if "seed" in lists else []
    values = sweep.composer.trial([word for word in sweep.words if not is_sweep(word)]).values
    metric = metric_and_question(str(values["eval"].get("primary") or ""))[0] or DEFAULT_METRIC
    direction, sign = better_direction(metric, values, "eval.primary"), _sign(node)
    log.info(
        "hydra/sweeper=%s gets %s%s of validation views, %s",
        sweep.other_sweeper,
        "-" if sign != direction else "",
        metric,
        "maximized" if sign > 0 else "minimized",
    )
    words = tuple(word for (word,) in seeds)
    return Goal(f"{values['name']}-tune", metric, direction, sign, words)


def _sign(sweeper: DictConfig) -> int:
    """1 for a sweeper (Optuna, Nevergrad, Ax) that looks for the largest value, else -1."""
    direction = sweeper.get("direction")
    name = str(getattr(direction, "name", direction)).lower()
    nevergrad, ax = (
        OmegaConf.select(sweeper, key)
        for key in ("optim.maximize", "ax_config.experiment.minimize")
    )
    return 1 if name == "maximize" or nevergrad is True or ax is False else -1
