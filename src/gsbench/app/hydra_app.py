"""Hydra's path: other sweepers and launchers than gsbench's own, callbacks, Hydra's files and logs.

`hydra.main` starts the chosen sweeper. Its launcher is always gsbench's, which composes and checks
the jobs that the sweeper proposes, and runs them itself or by the chosen launcher.
"""

import logging
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus
from hydra.types import HydraContext
from omegaconf import DictConfig, OmegaConf, open_dict, read_write

from gsbench.app.grids import GRIDS, run_sweep
from gsbench.app.hydra_main import FOLDER, run_main, words_for_files, words_for_new_folder
from gsbench.app.sweep import BASIC, HYDRA_ERRORS, OWN, Ended, Sweep, searched_metric
from gsbench.app.tuning import mean_of, words_of_point
from gsbench.config.command_words import grid_points
from gsbench.config.compose import Trial, check_permitted, installed_nodes
from gsbench.config.explain import explained
from gsbench.config.overrides import bare_key, is_sweep, key_of, parse_word, task_words
from gsbench.config.schema import check, plain
from gsbench.errors import GsbenchError, InputError
from gsbench.files import checked_runs_folder, storage_errors
from gsbench.launch.batch import begin
from gsbench.launch.jobs import Outcome, check_job_links, outcome_of_error
from gsbench.logs import set_up_logging
from gsbench.system.programs import allow_modules
from gsbench.words import command

MODE = "hydra.mode"
LAUNCHER = ("hydra/launcher", "hydra.launcher.")
RunBatch = Callable[..., list[Outcome]]  # `gsbench.launch.batch.run_batch`

log = logging.getLogger(__name__)


# ---- what another sweeper gets: values of validation views, over several seeds


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

    def jobs_of(self, job: Sequence[str]) -> list[list[str]]:
        """The words of a point's trials."""
        words = [*job, *words_of_point(self.home)]
        return [[*words, seed] for seed in self.seeds] or [words]

    def value(self, trials: Sequence[Trial]) -> float:
        """The value of a point with its ``trials``, which are done.

        Raises GsbenchError if one lacks the metric.
        """
        mean = mean_of(trials, self.metric)
        if mean is None:
            raise GsbenchError(
                f"{trials[0].files.label} has no {self.metric}, which the sweeper needs"
            )
        return mean * self.direction * self.sign


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
    (metric, direction), sign = searched_metric(values), _sign(node)
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


# ---- what Hydra calls


@dataclass
class Job:
    """The task of another launcher, perhaps in another process: it runs the trial of one job.

    ``run`` runs trials, ``allowed`` is what the command line permits, ``folder`` is where it was
    given.
    """

    run: RunBatch
    allowed: tuple[str, ...] = ()
    folder: str = field(default_factory=os.getcwd)

    def __call__(self, config: DictConfig) -> None:
        """Run the trial of a composed configuration; raises what made it fail."""
        # its command has written the questions down
        (outcome,) = self.run([self.trial(config)], asks=False)
        if outcome.status == "failed":  # the launcher passes on what is raised
            raise outcome.error

    def trial(self, config: DictConfig) -> Trial:
        """The trial, with the process as its command's: its folder, its modules, its log."""
        hydras: Any = HydraConfig.instance().cfg
        # Paths start where the command was given, also with hydra.job.chdir and on another node.
        if Path(self.folder).is_dir():
            os.chdir(self.folder)
        allow_modules(self.allowed, self.folder)
        # Checked here, too: a launcher composes its jobs itself.
        check_permitted(hydras, self.allowed)
        has_log = bool(hydras.hydra.job_logging.get("root"))
        set_up_logging(hydras.hydra.verbose, has_log)
        typed: Any = OmegaConf.to_container(hydras.hydra.overrides, resolve=False)
        of_hydra = [word for word in typed["hydra"] if key_of(word) not in (MODE, GRIDS)]
        overrides = (*of_hydra, *typed["task"])
        with open_dict(config), explained(overrides):
            config.allow_targets = list(self.allowed)
            trial = Trial(check(plain(config)), overrides)
        if has_log:  # Hydra's log lies elsewhere
            log.info("the trial's folder is %s", trial.folder)
        return trial


@dataclass
class HydraApp:
    """A command that `hydra.main` runs: what its plug-ins call in the command's own process."""

    sweep: Sweep
    run: RunBatch
    launcher: str  # its name
    goal: Goal | None = None  # of a sweeper that searches
    ended: Ended = field(default_factory=Ended)

    @property
    def job(self) -> Job:
        return Job(self.run, self.sweep.allowed)

    def __call__(self, config: DictConfig) -> None:
        """Run the single trial of a command without ``-m``."""
        trials = [self.job.trial(config)]
        self.ended.add(trials, self.run(trials))

    def run_sweep(self, context: HydraContext, config: DictConfig) -> None:
        """Run gsbench's own sweep, for its sweeper among Hydra's plug-ins."""
        set_up_logging(config.hydra.verbose)
        run_sweep(self.sweep, lambda trials: self._launch(trials, context, config, asks=True))

    def run_jobs(
        self, jobs: Sequence[Sequence[str]], context: HydraContext, config: DictConfig
    ) -> list[JobReturn]:
        """Run the jobs of another sweeper, for gsbench's launcher; returns their values."""
        of_jobs = [self.goal.jobs_of(job) if self.goal else [list(job)] for job in jobs]
        trials = self.sweep.trials([words for of_job in of_jobs for words in of_job])
        # a search writes no question
        outcomes = self._launch(trials, context, config, asks=self.goal is None)
        by_folder = {outcome.folder: outcome for outcome in outcomes}
        # where sweepers write what they found
        Path(config.hydra.sweep.dir).mkdir(parents=True, exist_ok=True)
        rest, returned = iter(trials), []
        for job, of_job in zip(jobs, of_jobs, strict=True):
            own = [next(rest) for _ in of_job]
            ended = JobReturn(overrides=job, status=JobStatus.COMPLETED)
            try:
                for outcome in (by_folder[trial.folder] for trial in own):
                    if outcome.status == "failed":
                        raise outcome.error
                ended.return_value = self.goal.value(own) if self.goal else None
            except GsbenchError as error:
                ended.return_value, ended.status = error, JobStatus.FAILED
            returned.append(ended)
        return returned

    def _launch(
        self, trials: Sequence[Trial], context: HydraContext, config: DictConfig, asks: bool
    ) -> list[Outcome]:
        """Run trials, which are checked, by the chosen launcher."""
        if self.launcher == OWN:
            outcomes = self.run(trials, asks=asks)
        else:
            with storage_errors(checked_runs_folder(trials[0].values["runs"])):
                begin(trials, asks)
            outcomes = self._by_launcher(trials, context, config)
        self.ended.add(trials, outcomes)
        return outcomes

    def _by_launcher(
        self, trials: Sequence[Trial], context: HydraContext, config: DictConfig
    ) -> list[Outcome]:
        own, name = self.sweep.config.hydra, self.launcher
        is_typed = own.runtime.choices["hydra/launcher"] == name
        files = own if is_typed else installed_nodes((f"hydra/launcher={name}",))
        # A sweeper of others was started with gsbench's launcher. The launcher composes each job by
        # these words, and Hydra 1.4 compares their launcher with its own.
        given: Any = OmegaConf.to_container(config.hydra.overrides.hydra, resolve=False)
        words = [word for word in given if not _is_of_launcher(word)]
        typed = [word for word in self.sweep.words if _is_of_launcher(word)]
        with read_write(config.hydra):  # Hydra 1.4 forbids changes
            config.hydra.launcher = files["launcher"]
            config.hydra.runtime.choices["hydra/launcher"] = name
            config.hydra.overrides.hydra = [*words, *(typed or [f"hydra/launcher={name}"])]
        config.allow_targets = list(self.sweep.allowed)
        self.sweep.keep_times(config)  # the launcher composes its jobs from it
        launcher = Plugins.instance().instantiate_launcher(
            hydra_context=context, task_function=self.job, config=config
        )
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
        # the public property `return_value` would write a line to stderr
        values = [one._return_value for one in returned]
        return [
            outcome_of_error(trial.folder, value)
            if isinstance(value, Exception)
            else Outcome(trial.folder, "done")
            for trial, value in zip(trials, values, strict=True)
        ]


# ---- a command


def run_by_hydra(sweep: Sweep, run: RunBatch) -> Ended | None:
    """Run a command by `hydra.main`; None if nothing in it needs Hydra's path."""
    config = sweep.config
    if not (sweep.hydra_words or sweep.other_sweeper):
        return None
    files = words_for_files(config, sweep.words, sweep.multirun)
    has_plugins = config.hydra.callbacks or config.hydra.hydra_logging.get("root")
    launcher = str(config.hydra.runtime.choices["hydra/launcher"])
    if not (sweep.other_sweeper or files or launcher != OWN or has_plugins):
        return None
    # First the folder itself, since Hydra would follow a link in its place.
    runs = checked_runs_folder(config.runs)
    check_job_links(runs, runs / FOLDER)
    # Hydra's own files are written by its launchers alone.
    is_serial = launcher == OWN and files and config.launch.name == "serial"
    app = HydraApp(sweep, run, BASIC if is_serial else launcher)
    words = [*sweep.words, *files, *words_for_new_folder(sweep)]
    words.append(f"{MODE}={config.hydra.mode.name}")
    if not sweep.other_sweeper:
        # Hydra would resolve the ${…} of grids when it makes the sweeper, before each trial's
        # values.
        run_main(app, [*words, *[f"{GRIDS}=[]"] * bool(config.hydra.sweeper.get("grids"))], config)
        return app.ended
    app.goal = goal_of(sweep)
    if app.goal:  # its seeds are no part of the search
        words = [word for word in words if key_of(word) != "seed" or not is_sweep(word)]
        params = config.hydra.sweeper.get("params") or {}
        words += ["~hydra.sweeper.params.seed"] * ("seed" in params)
    kept = [word for word in words if not _is_of_launcher(word)]
    _search(app, [*kept, f"hydra/launcher={OWN}"])
    return app.ended


def _is_of_launcher(word: str) -> bool:
    return key_of(word).startswith(LAUNCHER)


def _search(app: HydraApp, words: Sequence[str]) -> None:
    """Let another sweeper propose jobs; its errors are named as its own."""
    name, experiment = app.sweep.other_sweeper, app.sweep.config.name
    try:
        run_main(app, words, app.sweep.config)
    except (GsbenchError, *HYDRA_ERRORS):
        raise
    except Exception as error:  # it may raise any error for its settings
        message = " ".join(str(error).split())
        raise InputError(
            f"hydra/sweeper={name} raised {type(error).__name__}: {message}"
        ) from error
    home = app.goal.home if app.goal else experiment
    if app.goal or not app.ended.trials:
        log.info(
            "hydra/sweeper=%s has ended: %s; the table: %s",
            name,
            command("status", home),
            command("tables", home),
        )


def words_without_sweeper(sweep: Sweep) -> tuple[list[str], bool]:
    """The words of a dry run of another sweeper, and whether they are a sweep."""
    kept = [
        word
        for word in sweep.words
        if not key_of(word).startswith(("hydra/sweeper", "hydra.sweeper."))
    ]
    if sweep.other_sweeper == BASIC:
        return [*kept, f"hydra/sweeper={OWN}"], True
    points = sweep.config.hydra.sweeper.get("n_trials")
    count = "trials" if points is None else f"{points} trials (hydra.sweeper.n_trials)"
    print(
        f"hydra/sweeper={sweep.other_sweeper} searches: it proposes {count} from the results, so "
        "they are not known yet"
    )
    return [*(word for word in kept if not is_sweep(word)), f"hydra/sweeper={OWN}"], False
