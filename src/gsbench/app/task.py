"""Task function of the Hydra app: all trials of a sweep at once through gsbench's launcher, else one a call."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.types import Override
from hydra.core.utils import JobReturn, JobStatus
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext
from omegaconf import DictConfig

from gsbench.config.command_words import check_sweep
from gsbench.config.compose import ready_trial
from gsbench.config.hydra_job import words_of
from gsbench.config.sweep_jobs import compose_jobs
from gsbench.errors import GsbenchError, InputError
from gsbench.launch.batch import begin_for_another_launcher
from gsbench.launch.outcome import Outcome, objective, outcome_of_error
from gsbench.launch.trial import Trial
from gsbench.logs import set_up_logging
from gsbench.system.own_modules import allow_modules

OWN = "gsbench"  # the names of gsbench's own launcher and sweeper


class StopAfterListing(Exception):  # noqa: N818 - it is no error
    """Signal that the trials were listed, and that none is to be run."""


@dataclass
class Task:
    """The function that Hydra runs. ``handle`` runs trials, or only looks at them and raises `StopAfterListing`.

    ``grids`` are what gsbench's sweeper joins (`gsbench.app.grids`); ``trials`` and ``outcomes`` are what has come
    together, over all batches of a sweep.
    """

    handle: Callable[[Sequence[Trial]], list[Outcome]]
    look_only: bool = False
    grids: list[dict[str, str]] = field(default_factory=list)
    trials: list[Trial] = field(default_factory=list)
    outcomes: list[Outcome] = field(default_factory=list)

    def __call__(self, config: DictConfig) -> float | None:
        """One trial, as other launchers call it, perhaps in a process of its own; raises GsbenchError if it failed."""
        allow_modules(config.allow_targets)
        set_up_logging()
        for_hydra, words = words_of(HydraConfig.get().overrides)
        (outcome,) = self.handle([Trial.of(ready_trial(config, [*for_hydra, *words]))])
        if outcome.status != "done":
            raise (InputError if outcome.bad_input else GsbenchError)(outcome.message)
        return objective(outcome.metrics or {})

    def launch(self, trials: Sequence[Trial]) -> list[JobReturn]:
        """Run a batch of trials; raises GsbenchError where no other trial can succeed either."""
        self.trials += trials
        outcomes = self.handle(trials)
        self.outcomes += outcomes
        if fatal := next((outcome for outcome in outcomes if outcome.fatal), None):
            raise (InputError if fatal.bad_input else GsbenchError)(fatal.message)
        ended = {outcome.folder: outcome for outcome in outcomes}
        return [_returned(trial, ended[trial.folder]) for trial in trials]


def launch_jobs(
    task: Task, context: HydraContext, master: DictConfig, jobs: Sequence[Sequence[str]], first: int
) -> list[JobReturn]:
    """Run the jobs of a sweep for gsbench's launcher; each job is the list of its words."""
    return task.launch(trials_of_jobs(context, master, jobs, first))


def trials_of_jobs(
    context: HydraContext, master: DictConfig, jobs: Sequence[Sequence[str]], first: int = 0
) -> list[Trial]:
    """The trials of a sweep's jobs, whose numbers begin at ``first``."""
    return [Trial.of(composed) for composed in compose_jobs(context, master, jobs, first)]


def launch_trials(
    task: Task, master: DictConfig, launcher: Launcher, trials: Sequence[Trial], first: int | None = None
) -> Sequence[JobReturn]:
    """Run trials that a sweeper of gsbench's has composed, by any launcher.

    ``first`` is the number of the first job, by which Hydra's launchers name folders; by default the trial's own.
    Another launcher than gsbench's gets them after a look at all, so that what is refused is refused before any work.
    """
    name = master.hydra.runtime.choices["hydra/launcher"]
    if name == OWN or task.look_only:
        return task.launch(trials)
    begin_for_another_launcher(trials)
    jobs = [trial.job for trial in trials if trial.job is not None]
    try:
        returned = launcher.launch(
            [list(job.words) for job in jobs], initial_job_idx=(jobs[0].number or 0) if first is None else first
        )
    except GsbenchError:
        raise
    except Exception as error:
        message = " ".join(str(error).split()) or type(error).__name__
        raise GsbenchError(f"hydra/launcher={name}: {message} (gsbench status tells how far it came)") from error
    task.trials += trials
    task.outcomes += [_outcome(trial, ended) for trial, ended in zip(trials, returned, strict=True)]
    return returned


def grid(overrides: Sequence[Override]) -> list[list[str]]:
    """The words of every point of the grid that ``overrides`` span; of two for one key the later counts."""
    choices: dict[str, list[str]] = {}
    for override in overrides:
        key = override.get_key_element()
        if override.is_sweep_override():
            check_sweep(override)
            try:
                choices[key] = [f"{key}={value}" for value in override.sweep_string_iterator()]
            except ValueError as error:  # such as a range of steps of 0
                raise InputError(f"{override.input_line}: {error}") from error
            if not choices[key]:
                raise InputError(f"{override.input_line} lists no value")
        else:
            choices[key] = [key if override.is_delete() else f"{key}={override.get_value_element_as_str()}"]
    return [list(point) for point in product(*choices.values())]


def _returned(trial: Trial, outcome: Outcome) -> JobReturn:
    words = trial.job.words if trial.job is not None else trial.overrides
    returned = JobReturn(overrides=list(words), task_name="gsbench")
    if outcome.status == "done":
        returned.return_value, returned.status = objective(outcome.metrics or {}), JobStatus.COMPLETED
    elif outcome.status == "failed":
        returned.return_value, returned.status = GsbenchError(outcome.message), JobStatus.FAILED
    return returned  # left to Slurm: not known


def _outcome(trial: Trial, returned: JobReturn) -> Outcome:
    """Say how a trial ended that another launcher ran."""
    value: Any = returned._return_value  # the property of that name would write a line to stderr
    return outcome_of_error(trial.folder, value) if isinstance(value, Exception) else Outcome(trial.folder, "done")
