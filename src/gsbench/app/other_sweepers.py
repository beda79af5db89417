"""Another sweeper than gsbench's own: Hydra's, or one of an installed package."""

import logging
import shlex
from collections.abc import Sequence
from contextlib import suppress
from itertools import product

from omegaconf import DictConfig, OmegaConf

from gsbench.analysis.results import group_by
from gsbench.app.sweep import OWN, Objective, TrialTask, metric_of
from gsbench.config import compose
from gsbench.config.command_words import bare_key, grid_points, is_sweep, key_of, parse_word
from gsbench.config.compose import Trial
from gsbench.errors import GsbenchError, InputError
from gsbench.words import counted

GRID_SWEEPER = "basic"  # Hydra's own, which expands lists and asks for no values
MAX_CHOICES = 1000  # of groups, in a sweep of another sweeper

log = logging.getLogger(__name__)


def other_sweeper(config: DictConfig) -> str:
    """The name of the chosen sweeper; empty if it is gsbench's."""
    name = str(config.hydra.runtime.choices["hydra/sweeper"])
    return "" if name == OWN else name


def words_without_sweeper(
    config: DictConfig, words: Sequence[str], name: str
) -> tuple[list[str], bool]:
    """The words of a dry run of another sweeper, and whether they are a sweep."""
    kept = [
        word for word in words if not key_of(word).startswith(("hydra/sweeper", "hydra.sweeper."))
    ]
    if name == GRID_SWEEPER:
        return [*kept, f"hydra/sweeper={OWN}"], True
    points = config.hydra.sweeper.get("n_trials")
    count = "trials" if points is None else f"{points} trials (hydra.sweeper.n_trials)"
    print(
        f"hydra/sweeper={name} searches: it proposes {count} from the results, so they are not "
        "known yet"
    )
    return [*(word for word in kept if not is_sweep(word)), f"hydra/sweeper={OWN}"], False


def prepare_other_sweeper(
    config: DictConfig, words: Sequence[str], task: TrialTask, name: str
) -> list[str]:
    """Set the objective of the ``task`` for another sweeper; returns the words for Hydra.

    Raises InputError for a choice among the words that would run what is not allowed: Hydra reads a
    job's logging before the job can be checked.
    """
    params = config.hydra.sweeper.get("params") or {}
    lists = {bare_key(str(key)): f"{key}={value}" for key, value in params.items()}
    lists |= {key_of(word): word for word in words if is_sweep(word)}
    choices = [
        grid_points([parse_word(word)])
        for key, word in lists.items()
        if "." not in key and key != "seed"
    ]
    for number, point in enumerate(product(*choices)):
        if number == MAX_CHOICES:
            raise InputError(
                f"hydra/sweeper={name}: more than {MAX_CHOICES} combinations of choices"
            )
        with compose.hydra_ready():
            compose.compose_whole(
                [*(w for w in words if not is_sweep(w)), *(word for (word,) in point)]
            )
    if name == GRID_SWEEPER:
        task.objective = Objective(-1)
        return list(words)
    with compose.hydra_ready():
        metric, direction = metric_of(compose.resolve_trial(config, words).values)
    sign = 1 if _maximizes(config.hydra.sweeper) else -1
    # A search must not choose among seeds: each job has them all.
    seeds = (
        [word for (word,) in grid_points([parse_word(lists["seed"])])] if "seed" in lists else []
    )
    task.objective = Objective(sign, tuple(seeds))
    log.info(
        "hydra/sweeper=%s gets %s%s of test views, %s; gsbench's own sweeper would tune on "
        "validation views and can stop by looks",
        name,
        "-" if sign != direction else "",
        metric,
        "maximized" if sign > 0 else "minimized",
    )
    kept = [word for word in words if key_of(word) != "seed" or not is_sweep(word)]
    return kept + ["~hydra.sweeper.params.seed"] * ("seed" in params)


def best_line(trials: Sequence[Trial], objective: Objective | None) -> str:
    """The best values that a sweeper proposed, with the command that repeats them.

    It is "" if no job has all of its values.
    """
    if objective is None:
        return ""
    by_job = group_by(trials, lambda trial: _job_words(trial, without="seed"))
    values: dict[tuple[str, ...], float] = {}
    for words, own in by_job.items():
        with suppress(GsbenchError):  # a job that failed has no value
            values[words] = objective.value(own)
    if not values:
        return ""
    best = max(values, key=lambda words: objective.sign * values[words])
    metric, direction = metric_of(trials[0].values)
    swept = [word for word in best if not all(word in words for words in by_job)]
    seeds = dict.fromkeys(str(trial.values["seed"]) for trial in by_job[best])
    command = [*best, f"seed={','.join(seeds)}"]
    return (
        f"best: {' '.join(swept) or 'the only job'}, {metric} "
        f"{values[best] * direction * objective.sign:.4g} of test views "
        f"({counted(len(seeds), 'seed')}); again: gsbench "
        f"{'-m ' * (len(seeds) > 1)}{shlex.join(command)}"
    )


def _job_words(trial: Trial, without: str) -> tuple[str, ...]:
    """The words of a trial's job without Hydra's own and without one key."""
    return tuple(
        word
        for word in trial.overrides
        if key_of(word) != without and not parse_word(word).is_hydra_override()
    )


def _maximizes(sweeper: DictConfig) -> bool:
    """Return whether a sweeper (Optuna, Nevergrad, Ax) was told to look for the largest value."""
    direction = sweeper.get("direction")
    name = str(getattr(direction, "name", direction)).lower()
    nevergrad, ax = (
        OmegaConf.select(sweeper, key)
        for key in ("optim.maximize", "ax_config.experiment.minimize")
    )
    return name == "maximize" or nevergrad is True or ax is False
