"""The task that Hydra runs for each job, and a sweep that Hydra has started.

Hydra's task function is `TrialTask`. gsbench's own sweeper hands all trials to it as one batch.
Another launcher calls it for each job, perhaps in another process. Another sweeper proposes the
jobs, and gets a value for each.
"""

import copy
import logging
import os
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

from hydra.core.config_loader import ConfigLoader
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, RunMode, TaskFunction
from omegaconf import DictConfig

from gsbench.claims.stopping import facts_for
from gsbench.config import compose
from gsbench.config.command_words import check_removal, parse_word
from gsbench.config.compose import Trial
from gsbench.errors import GsbenchError, InputError
from gsbench.launch.batch import begin_for_another_launcher
from gsbench.launch.jobs import Outcome, outcome_of_error
from gsbench.logs import set_up_logging
from gsbench.runs.experiments import metric_and_question
from gsbench.system.own_modules import allow_modules

OWN = "gsbench"  # the name of the launcher and of the sweeper in Hydra
DEFAULT_METRIC = "psnr"

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Objective:
    """The value that another sweeper gets for a job: the mean of a metric over the job's seeds.

    ``sign`` says what the sweeper looks for: the largest value (1) or the least (-1). A metric
    whose better direction is the other one is negated. ``seeds`` are the words of the seeds; if
    empty, the job's own seed is used.
    """

    sign: int
    seeds: tuple[str, ...] = ()

    def value(self, trials: Sequence[Trial]) -> float:
        """The value of a job's ``trials``, which are done.

        Raises GsbenchError if one lacks the metric.
        """
        metric, direction = metric_of(trials[0].values)
        records = [trial.files.sound_record() for trial in trials]
        values = [record.metrics.get(metric) for record in records if record is not None]
        found = [value for value in values if value is not None]
        if len(found) < len(trials):
            raise GsbenchError(f"{trials[0].files.label} has no {metric}, which the sweeper needs")
        return statistics.fmean(found) * direction * self.sign


def metric_of(values: Mapping[str, Any]) -> tuple[str, int]:
    """The metric that judges a trial (``eval.primary``, else PSNR); 1 if more is better, or -1."""
    metric = metric_and_question(str(values["eval"].get("primary") or ""))[0] or DEFAULT_METRIC
    direction = facts_for(metric, values).direction
    if not direction:
        raise InputError(
            f"eval.primary={metric}: whether more or less of it is better is not known"
        )
    return metric, 1 if direction > 0 else -1


@dataclass
class TrialTask:
    """Hydra's task function: it gets a composed configuration and hands its trial to ``handle``.

    ``handle`` runs trials; with ``look_only`` it only reports what would run. ``allowed`` is what
    the command line permits, ``folder`` is where it was given, ``grids`` are the grids that
    gsbench's sweeper joins. ``objective`` is for another sweeper. ``trials`` and ``outcomes``
    collect all batches of a sweep.
    """

    handle: Callable[[Sequence[Trial]], list[Outcome]]
    look_only: bool = False
    allowed: tuple[str, ...] = ()
    folder: str = field(default_factory=os.getcwd)
    grids: Any = None
    objective: Objective | None = None
    trials: list[Trial] = field(default_factory=list)
    outcomes: list[Outcome] = field(default_factory=list)

    def __reduce__(self) -> tuple[Any, ...]:
        # Pickled for another launcher's processes, which need nothing that was collected here.
        return TrialTask, (
            self.handle,
            self.look_only,
            self.allowed,
            self.folder,
            None,
            self.objective,
        )

    def __call__(self, config: DictConfig) -> float | None:
        """Run one job; returns its value for another sweeper, else None.

        Hydra or another launcher calls it, perhaps in another process. Raises InputError or
        GsbenchError if a trial of a sweep's job failed.
        """
        # Paths of the command line start where it was given, also with hydra.job.chdir and on a
        # node of a cluster.
        if Path(self.folder).is_dir():
            os.chdir(self.folder)
        allow_modules(self.allowed, self.folder)
        hydra: Any = HydraConfig.instance().cfg
        # Checked again, because the files that this job chooses may set other settings of Hydra
        # than those that were checked.
        compose.check_permitted(hydra, self.allowed)
        has_log = bool(hydra.hydra.job_logging.get("root"))
        set_up_logging(hydra.hydra.verbose, has_log)
        hydra_words, words = compose.typed_words(hydra.hydra.overrides)
        compose.enforce_permissions(config, self.allowed)
        seeds = self.objective.seeds if self.objective else ()
        trials = [compose.resolve_trial(config, [*hydra_words, *words])]
        if seeds:
            trials = [
                self._trial_of_seed(config, word, [*hydra_words, *words, word]) for word in seeds
            ]
        for trial in trials if has_log else ():  # Hydra's log lies elsewhere
            log.info("the trial's folder is %s", trial.folder)
        if hydra.hydra.mode == RunMode.RUN:
            self.launch(trials)
            return None
        # A job of a sweep: its launcher passes on what is raised.
        outcomes = self.handle(trials)
        if self.objective:  # another sweeper does not collect them
            self.trials += trials
            self.outcomes += outcomes
        for outcome in outcomes:
            if outcome.status == "failed":
                raise (InputError if outcome.bad_input else GsbenchError)(outcome.message)
        return self.objective.value(trials) if self.objective else None

    @staticmethod
    def _trial_of_seed(config: DictConfig, word: str, words: Sequence[str]) -> Trial:
        own = copy.deepcopy(config)
        own.seed = parse_word(word).value()
        return compose.resolve_trial(own, words)

    def launch(self, trials: Sequence[Trial]) -> None:
        """Run a batch of trials."""
        self.trials += trials
        self.outcomes += self.handle(trials)


@dataclass(frozen=True)
class Sweep:
    """A sweep: its whole configuration, task, Hydra's loader of configurations, and launcher."""

    config: DictConfig
    task: TrialTask
    loader: ConfigLoader
    launcher: Launcher | None = None  # None: gsbench's own, called by another sweeper

    @classmethod
    def begin(cls, context: HydraContext, task: TaskFunction, config: DictConfig) -> Self:
        """Make a sweep from what Hydra gives a sweeper."""
        assert isinstance(task, TrialTask)
        set_up_logging(config.hydra.verbose)
        config.allow_targets = list(task.allowed)
        launcher = Plugins.instance().instantiate_launcher(
            hydra_context=context, task_function=task, config=config
        )
        return replace(cls.plan(context.config_loader, task, config), launcher=launcher)

    @classmethod
    def plan(cls, loader: ConfigLoader, task: TrialTask, config: DictConfig) -> Self:
        """Make a sweep without a launcher, for a task that only looks."""
        compose.resolve_times(config)
        return cls(config, task, loader)

    def parse(self, words: Sequence[str]) -> list[Override]:
        """The words as Hydra reads them, with the choices of ``glob(*)``."""
        for word in words:  # those from a file were not checked before
            if (override := parse_word(word)).is_delete():
                check_removal(override)
        with compose.explained(words):
            return OverridesParser.create(self.loader).parse_overrides(list(words))

    def trials(self, jobs: Sequence[Sequence[str]]) -> list[Trial]:
        """The trials of ``jobs``, each the list of its words."""
        return compose.compose_jobs(self.loader, self.config, jobs)

    def launch(self, trials: Sequence[Trial]) -> None:
        """Run trials by the launcher.

        For another launcher than gsbench's, all trials are checked before the first.
        """
        name = self.config.hydra.runtime.choices["hydra/launcher"]
        if name == OWN or self.task.look_only:
            self.task.launch(trials)
            return
        assert self.launcher is not None
        begin_for_another_launcher(trials)
        jobs = [
            [word for word in trial.overrides if not parse_word(word).is_hydra_override()]
            for trial in trials
        ]
        try:
            returned = self.launcher.launch(jobs, initial_job_idx=len(self.task.trials))
        except GsbenchError:
            raise
        except Exception as error:
            message = " ".join(str(error).split()) or type(error).__name__
            raise GsbenchError(
                f"hydra/launcher={name}: {message} (gsbench status tells how far it came)"
            ) from error
        self.task.trials += trials
        self.task.outcomes += [
            _outcome(trial, ended) for trial, ended in zip(trials, returned, strict=True)
        ]

    def run_jobs(self, jobs: Sequence[Sequence[str]]) -> list[JobReturn]:
        """Run the jobs that another sweeper proposes as one batch; returns their values."""
        objective = self.task.objective
        assert objective is not None
        seeds = objective.seeds
        trials = self.trials(
            [[*job, *own] for job in jobs for own in ([[word] for word in seeds] or [[]])]
        )
        first = len(self.task.outcomes)
        self.task.launch(trials)
        # where sweepers write what they found
        Path(self.config.hydra.sweep.dir).mkdir(parents=True, exist_ok=True)
        outcomes = {outcome.folder: outcome for outcome in self.task.outcomes[first:]}
        size = max(1, len(seeds))
        own_trials = [trials[start : start + size] for start in range(0, len(trials), size)]
        return [
            _returned(job, own, outcomes, objective)
            for job, own in zip(jobs, own_trials, strict=True)
        ]


def _returned(
    job: Sequence[str],
    trials: Sequence[Trial],
    outcomes: Mapping[Path, Outcome],
    objective: Objective,
) -> JobReturn:
    """The value or the error of a job, as a launcher returns it to another sweeper."""
    returned = JobReturn(overrides=job)
    try:
        for outcome in (outcomes[trial.folder] for trial in trials):
            if outcome.status != "done":
                raise (InputError if outcome.bad_input else GsbenchError)(outcome.message)
        returned.return_value, returned.status = objective.value(trials), JobStatus.COMPLETED
    except GsbenchError as error:
        returned.return_value, returned.status = error, JobStatus.FAILED
    return returned


def _outcome(trial: Trial, returned: JobReturn) -> Outcome:
    """The outcome of a trial that another launcher ran."""
    # the public property `return_value` would write a line to stderr
    value: Any = returned._return_value
    return (
        outcome_of_error(trial.folder, value)
        if isinstance(value, Exception)
        else Outcome(trial.folder, "done")
    )
