"""The values that another sweeper of Hydra's gets: of validation views, over several seeds."""

import logging
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field

from omegaconf import DictConfig, OmegaConf

from gsbench.app.sweep import BASIC, Sweep, better_direction
from gsbench.app.tuning import mean_of, words_of_point
from gsbench.config.command_words import grid_points
from gsbench.config.compose import Trial
from gsbench.config.overrides import bare_key, is_sweep, key_of, parse_word
from gsbench.errors import GsbenchError
from gsbench.runs.experiments import DEFAULT_METRIC, metric_and_question
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
    # the means of the metric, by the words of the jobs
    values: dict[tuple[str, ...], float] = field(default_factory=dict)

    def jobs_of(self, job: Sequence[str]) -> list[list[str]]:
        """The words of a point's trials."""
        words = [*job, *words_of_point(self.home)]
        return [[*words, seed] for seed in self.seeds] or [words]

    def value(self, job: Sequence[str], trials: Sequence[Trial]) -> float:
        """The value of a job with its ``trials``, which are done.

        Raises GsbenchError if one lacks the metric.
        """
        mean = mean_of(trials, self.metric)
        if mean is None:
            raise GsbenchError(
                f"{trials[0].files.label} has no {self.metric}, which the sweeper needs"
            )
        self.values[tuple(job)] = mean
        return mean * self.direction * self.sign

    def best_line(self) -> str:
        """The best values, with the command that trains them; "" if no point has a value."""
        if not self.values:
            return ""
        best = max(self.values, key=lambda job: self.values[job] * self.direction)
        swept = [word for word in best if not all(word in job for job in self.values)]
        seeds = ",".join(word.partition("=")[2] for word in self.seeds)
        words = [*best, *[f"seed={seeds}"] * bool(seeds)]
        words = ["-m", *words] if len(self.seeds) > 1 else words
        what, seeds = " ".join(swept) or "the only point", counted(max(1, len(self.seeds)), "seed")
        return (
            f"best: {what}, {self.metric} {self.values[best]:.4g} of validation views ({seeds}, in "
            f"{self.home}); to train it: gsbench {shlex.join(words)}"
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
    values = sweep.trial([word for word in sweep.words if not is_sweep(word)]).values
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
