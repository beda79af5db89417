"""The places where Hydra's plug-ins attach: sweepers, launchers, callbacks, and Hydra's own files.

`hydra.main` calls a `TrialTask` for a single trial, and for each job of another launcher, perhaps
in another process. Another sweeper proposes the jobs, and gets a value for each. Without plug-ins,
trials run without `hydra.main`.
"""

import copy
import itertools
import logging
import os
import shlex
import statistics
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, RunMode
from omegaconf import DictConfig, OmegaConf

from gsbench.analysis.advice import GRIDS
from gsbench.analysis.results import group_by
from gsbench.app.grids import run_sweep
from gsbench.app.hydra_files import check_links, words_for_hydras_files, words_for_new_folder
from gsbench.app.hydra_main import run_main
from gsbench.app.sweep import DEFAULT_METRIC, HYDRA_ERRORS, OWN, Ended, Sweep, better_direction
from gsbench.config.command_words import grid_points
from gsbench.config.compose import Trial, check_permitted, trial_of_job
from gsbench.config.overrides import bare_key, is_sweep, key_of, parse_word, task_words
from gsbench.errors import GsbenchError, InputError
from gsbench.files import checked_runs_folder
from gsbench.launch.batch import begin_for_another_launcher
from gsbench.launch.jobs import Outcome, outcome_of_error
from gsbench.logs import set_up_logging
from gsbench.runs.experiments import metric_and_question
from gsbench.system.own_modules import allow_modules
from gsbench.words import command, counted

GRID_SWEEPER = "basic"  # Hydra's own, which expands lists and asks for no values
MAX_CHOICES = 1000  # of groups, in a sweep of another sweeper
MODE = "hydra.mode"

log = logging.getLogger(__name__)


# ---- the task that Hydra calls


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
    return metric, better_direction(metric, values, "eval.primary")


@dataclass
class TrialTask:
    """Hydra's task function: it gets a composed configuration and runs its trial.

    ``run`` runs trials, ``allowed`` is what the command line permits, ``folder`` is where it was
    given. ``objective`` is for another sweeper. ``sweep`` is what the command asks for, and
    ``ended`` what came of it, in the command's own process.
    """

    run: Callable[[Sequence[Trial]], list[Outcome]]
    allowed: tuple[str, ...] = ()
    folder: str = field(default_factory=os.getcwd)
    objective: Objective | None = None
    sweep: Sweep | None = None
    ended: Ended = field(default_factory=Ended)

    def __reduce__(self) -> tuple[Any, ...]:
        # Pickled for another launcher's processes, which need nothing of the command's own.
        return TrialTask, (self.run, self.allowed, self.folder, self.objective)

    def __call__(self, config: DictConfig) -> float | None:
        """Run one job; returns its value for another sweeper, else None.

        Hydra or another launcher calls it, perhaps in another process. Raises InputError or
        GsbenchError if a trial of a sweep's job failed.
        """
        hydras: Any = HydraConfig.instance().cfg
        self._prepare(hydras)
        trials = self._compose(config, hydras.hydra.overrides)
        if hydras.hydra.job_logging.get("root"):  # Hydra's log lies elsewhere
            for trial in trials:
                log.info("the trial's folder is %s", trial.folder)
        outcomes = self.run(trials)
        is_job = hydras.hydra.mode != RunMode.RUN
        if not is_job or self.objective:  # else the launcher's caller collects them
            self.ended.add(trials, outcomes)
        return self._report(trials, outcomes) if is_job else None

    def _prepare(self, hydras: DictConfig) -> None:
        # Paths of the command line start where it was given, also with hydra.job.chdir and on a
        # node of a cluster.
        if Path(self.folder).is_dir():
            os.chdir(self.folder)
        allow_modules(self.allowed, self.folder)
        # Checked again, because the files that this job chooses may set other settings of Hydra
        # than those that were checked.
        check_permitted(hydras, self.allowed)
        set_up_logging(hydras.hydra.verbose, bool(hydras.hydra.job_logging.get("root")))

    def _compose(self, config: DictConfig, typed: DictConfig) -> list[Trial]:
        """The job's trial, or one for each seed of the objective."""
        words: Any = OmegaConf.to_container(typed, resolve=False)
        of_hydra = [word for word in words["hydra"] if word.partition("=")[0] not in (MODE, GRIDS)]
        overrides, trials = [*of_hydra, *words["task"]], []
        for word in self.objective.seeds if self.objective else ():
            of_seed = copy.deepcopy(config)
            of_seed.seed = parse_word(word).value()
            trials.append(trial_of_job(of_seed, self.allowed, [*overrides, word]))
        return trials or [trial_of_job(config, self.allowed, overrides)]

    def _report(self, trials: Sequence[Trial], outcomes: Sequence[Outcome]) -> float | None:
        for outcome in outcomes:
            if outcome.status == "failed":  # the launcher passes on what is raised
                raise (InputError if outcome.bad_input else GsbenchError)(outcome.message)
        return self.objective.value(trials) if self.objective else None

    # ---- what gsbench's plug-ins call, in the command's own process

    def run_sweep(self, context: HydraContext, config: DictConfig) -> None:
        """Run the trials of gsbench's own sweeper by the launcher that Hydra's ``config`` names."""
        assert self.sweep is not None
        set_up_logging(config.hydra.verbose)
        name = config.hydra.runtime.choices["hydra/launcher"]
        if name == OWN:
            run_sweep(self.sweep, lambda trials: self.ended.add(trials, self.run(trials)))
            return
        config.allow_targets = list(self.allowed)
        launcher = Plugins.instance().instantiate_launcher(
            hydra_context=context, task_function=self, config=config
        )
        composer = self.sweep.composer

        def run(trials: Sequence[Trial]) -> None:
            composer.keep_times(config)  # the launcher composes its jobs from it
            self._launch(trials, launcher, name)

        run_sweep(self.sweep, run)

    def _launch(self, trials: Sequence[Trial], launcher: Launcher, name: str) -> None:
        """Run trials by another launcher than gsbench's; all are checked before the first."""
        begin_for_another_launcher(trials)
        jobs = [task_words(trial.overrides) for trial in trials]
        try:
            returned = launcher.launch(jobs, initial_job_idx=len(self.ended.trials))
        except GsbenchError:
            raise
        except Exception as error:
            message = " ".join(str(error).split()) or type(error).__name__
            raise GsbenchError(
                f"hydra/launcher={name}: {message} (gsbench status tells how far it came)"
            ) from error
        self.ended.add(
            trials, [_outcome(trial, ended) for trial, ended in zip(trials, returned, strict=True)]
        )

    def run_jobs(self, jobs: Sequence[Sequence[str]], config: DictConfig) -> list[JobReturn]:
        """Run the jobs that another sweeper proposes as one batch; returns their values."""
        assert self.objective is not None
        assert self.sweep is not None
        seeds = [[word] for word in self.objective.seeds] or [[]]
        trials = self.sweep.composer.trials([[*job, *own] for job in jobs for own in seeds])
        outcomes = self.run(trials)
        self.ended.add(trials, outcomes)
        # where sweepers write what they found
        Path(config.hydra.sweep.dir).mkdir(parents=True, exist_ok=True)
        by_folder = {outcome.folder: outcome for outcome in outcomes}
        rest, returned = iter(trials), []
        for job in jobs:
            own = list(itertools.islice(rest, len(seeds)))
            ended = JobReturn(overrides=job, status=JobStatus.COMPLETED)
            try:
                ended.return_value = self._report(own, [by_folder[trial.folder] for trial in own])
            except GsbenchError as error:
                ended.return_value, ended.status = error, JobStatus.FAILED
            returned.append(ended)
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


# ---- gsbench's own sweep with plug-ins


def words_for_plugins(sweep: Sweep) -> list[str] | None:
    """The words for `hydra.main` to run gsbench's own sweep; None if no plug-in has work there."""
    if not sweep.composer.hydra_words:
        return None
    config = sweep.config
    files = words_for_hydras_files(config, sweep.words, sweep.multirun)
    launcher = config.hydra.runtime.choices["hydra/launcher"]
    if not (
        files or launcher != OWN or config.hydra.callbacks or config.hydra.hydra_logging.get("root")
    ):
        return None
    check_links(checked_runs_folder(config.runs))
    # Hydra would resolve the ${…} of grids when it makes the sweeper, before each trial's values.
    grids = [f"{GRIDS}=[]"] if config.hydra.sweeper.get("grids") else []
    place = words_for_new_folder(config, sweep.words)
    return [*sweep.words, *files, *place, *grids, f"{MODE}={config.hydra.mode.name}"]


# ---- another sweeper than gsbench's own: Hydra's, or one of an installed package


def other_sweep(sweep: Sweep, run: Callable[[Sequence[Trial]], list[Outcome]]) -> Ended:
    """Let another sweeper propose the jobs, and run them."""
    name, config = sweep.other_sweeper, sweep.config
    words, objective = prepare_other_sweeper(sweep)
    check_links(checked_runs_folder(config.runs))
    words += words_for_hydras_files(config, sweep.words, multirun=True)
    words += words_for_new_folder(config, sweep.words)
    task = TrialTask(run, sweep.composer.allowed, objective=objective, sweep=sweep)
    try:
        run_main(task, [*words, f"{MODE}=MULTIRUN"], config)
    except (GsbenchError, *HYDRA_ERRORS):
        raise
    except Exception as error:  # it may raise any error for its settings
        message = " ".join(str(error).split())
        raise InputError(
            f"hydra/sweeper={name} raised {type(error).__name__}: {message}"
        ) from error
    if not task.ended.trials:
        log.info(
            "hydra/sweeper=%s has ended: %s; the table: %s",
            name,
            command("status", config.name),
            command("tables", config.name),
        )
    elif name != GRID_SWEEPER and (best := best_line(task.ended.trials, objective)):
        log.info("hydra/sweeper=%s: %s", name, best)
    return task.ended


def best_line(trials: Sequence[Trial], objective: Objective) -> str:
    """The best values that a sweeper proposed, with the command that repeats them.

    It is "" if no job has all of its values.
    """
    by_job = group_by(trials, _words_without_seed)
    values: dict[tuple[str, ...], float] = {}
    for words, of_job in by_job.items():
        with suppress(GsbenchError):  # a job that failed has no value
            values[words] = objective.value(of_job)
    if not values:
        return ""
    best = max(values, key=lambda words: objective.sign * values[words])
    metric, direction = metric_of(trials[0].values)
    swept = [word for word in best if not all(word in words for words in by_job)]
    seeds = dict.fromkeys(str(trial.values["seed"]) for trial in by_job[best])
    command = [*best, f"seed={','.join(seeds)}"]
    if len(seeds) > 1:
        command.insert(0, "-m")
    return (
        f"best: {' '.join(swept) or 'the only job'}, {metric} "
        f"{values[best] * direction * objective.sign:.4g} of test views "
        f"({counted(len(seeds), 'seed')}); again: gsbench {shlex.join(command)}"
    )


def _words_without_seed(trial: Trial) -> tuple[str, ...]:
    """The words of a trial's job without the seed and those for Hydra."""
    return tuple(word for word in task_words(trial.overrides) if key_of(word) != "seed")


def words_without_sweeper(sweep: Sweep) -> tuple[list[str], bool]:
    """The words of a dry run of another sweeper, and whether they are a sweep."""
    kept = [
        word
        for word in sweep.words
        if not key_of(word).startswith(("hydra/sweeper", "hydra.sweeper."))
    ]
    if sweep.other_sweeper == GRID_SWEEPER:
        return [*kept, f"hydra/sweeper={OWN}"], True
    points = sweep.config.hydra.sweeper.get("n_trials")
    count = "trials" if points is None else f"{points} trials (hydra.sweeper.n_trials)"
    print(
        f"hydra/sweeper={sweep.other_sweeper} searches: it proposes {count} from the results, so "
        "they are not known yet"
    )
    return [*(word for word in kept if not is_sweep(word)), f"hydra/sweeper={OWN}"], False


def prepare_other_sweeper(sweep: Sweep) -> tuple[list[str], Objective]:
    """The words for Hydra by which another sweeper runs, and what it gets for each job.

    Raises InputError for a choice among the words that would run what is not allowed: Hydra reads a
    job's logging before the job can be checked.
    """
    words, name = list(sweep.words), sweep.other_sweeper
    single = [word for word in words if not is_sweep(word)]
    params = sweep.config.hydra.sweeper.get("params") or {}
    lists = {bare_key(str(key)): f"{key}={value}" for key, value in params.items()}
    lists |= {key_of(word): word for word in words if is_sweep(word)}
    choices = [
        grid_points([parse_word(word)])
        for key, word in lists.items()
        if "." not in key and key != "seed"
    ]
    own = task_words(single)
    for number, point in enumerate(itertools.product(*choices)):
        if number == MAX_CHOICES:
            raise InputError(
                f"hydra/sweeper={name}: more than {MAX_CHOICES} combinations of choices"
            )
        sweep.composer.settings([*own, *(word for (word,) in point)])
    if name == GRID_SWEEPER:
        return words, Objective(-1)
    metric, direction = metric_of(sweep.composer.trial(single).values)
    sign = 1 if _maximizes(sweep.config.hydra.sweeper) else -1
    # A search must not choose among seeds: each job has them all.
    seeds = (
        [word for (word,) in grid_points([parse_word(lists["seed"])])] if "seed" in lists else []
    )
    log.info(
        "hydra/sweeper=%s gets %s%s of test views, %s; gsbench's own sweeper would tune on "
        "validation views and can stop by looks",
        name,
        "-" if sign != direction else "",
        metric,
        "maximized" if sign > 0 else "minimized",
    )
    kept = [word for word in words if key_of(word) != "seed" or not is_sweep(word)]
    if "seed" in params:
        kept.append("~hydra.sweeper.params.seed")
    return kept, Objective(sign, tuple(seeds))


def _maximizes(sweeper: DictConfig) -> bool:
    """Return whether a sweeper (Optuna, Nevergrad, Ax) was told to look for the largest value."""
    direction = sweeper.get("direction")
    name = str(getattr(direction, "name", direction)).lower()
    nevergrad, ax = (
        OmegaConf.select(sweeper, key)
        for key in ("optim.maximize", "ax_config.experiment.minimize")
    )
    return name == "maximize" or nevergrad is True or ax is False
