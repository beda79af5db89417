"""A search by another sweeper: it gets the values of validation views, and writes no question."""

import logging
import shlex
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field

from omegaconf import DictConfig, OmegaConf

from gsbench.app.arm_search import measured, words_of_point
from gsbench.app.sweep import BASIC, DEFAULT_METRIC, Sweep, better_direction
from gsbench.config.command_words import grid_points
from gsbench.config.compose import Trial
from gsbench.config.overrides import bare_key, is_sweep, key_of, parse_word
from gsbench.errors import GsbenchError
from gsbench.runs.experiments import metric_and_question
from gsbench.words import counted

log = logging.getLogger(__name__)


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
