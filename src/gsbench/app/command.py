"""gsbench as a Hydra app: a command line becomes trials and an exit code.

Before Hydra runs, one look at the whole configuration refuses what cannot be (`gsbench.config.compose`). Then
``hydra.main`` runs the task, or makes a sweep of it by gsbench's sweeper.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.errors import HydraException
from hydra.types import HydraContext, RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gsbench.config.command_words import check_words, is_sweep, parse, parse_word
from gsbench.config.compose import Trial, compose_whole, look_at, ready_trial
from gsbench.config.hydra_entry import explained, hydra_ready, run_main
from gsbench.config.jobs import typed
from gsbench.config.trust import PERMISSIONS, check_composed, load_callbacks
from gsbench.errors import GsbenchError, InputError
from gsbench.launch.batch import check_parts, missing_folders, need_no_check, run_batch
from gsbench.launch.dry_run import describe_plan
from gsbench.launch.serial import Outcome
from gsbench.logs import set_up_logging
from gsbench.system.own_modules import allow_modules

OWN = "gsbench"  # the names of gsbench's own launcher and sweeper
OWN_FOLDER = {"dir": "${runs}/.hydra", "subdir": "."}  # of Hydra's files of a sweep, as conf/config.yaml has it

log = logging.getLogger(__name__)


def launch(argv: list[str]) -> int:
    """Run the trials of the command line ``argv``; 0 if all are done (or left to Slurm), 1 if some failed.

    Raises InputError for a configuration that does not compose or hold together, and for a single trial's bad input.
    """
    words, multirun, dry_run = parse(argv)
    task = Task(list_trials, look_only=True) if dry_run else Task(run_batch)
    run_app(words, multirun, task)
    if dry_run or not task.trials:  # a sweep that is decided needs none
        return 0
    return summarize(task.outcomes, task.trials)


def compose_trials(words: Sequence[str], multirun: bool = False) -> list[Trial]:
    """The trials that a command line would run."""
    task = Task(lambda trials: [], look_only=True)
    run_app(words, multirun, task)
    return task.trials


def run_trials(trials: Sequence[Trial]) -> int:
    """Run what is not done among ``trials`` by the launcher that they name; the exit code."""
    return summarize(run_batch(trials), trials)


class StopAfterListing(GsbenchError):  # noqa: N818 - it is no error
    """Signal that the trials were listed, and that none is to be run."""


@dataclass
class Task:
    """The function that Hydra runs. ``handle`` runs trials; where it shall ``look_only``, it says what would run.

    ``allowed`` is what the command line permits, with the user's modules in ``folder``; ``grids`` are what gsbench's
    sweeper joins. ``trials`` and ``outcomes`` are what has come together, over all batches of a sweep.
    """

    handle: Callable[[Sequence[Trial]], list[Outcome]]
    look_only: bool = False
    allowed: tuple[str, ...] = ()
    folder: str = field(default_factory=os.getcwd)
    grids: Any = None
    trials: list[Trial] = field(default_factory=list)
    outcomes: list[Outcome] = field(default_factory=list)

    def __reduce__(self) -> tuple[Any, ...]:
        return Task, (self.handle, self.look_only, self.allowed, self.folder)  # nothing of what came together here

    def __call__(self, config: DictConfig) -> None:
        """One trial, as Hydra or another launcher calls it, perhaps in a process of its own; raises how it failed."""
        allow_modules(self.allowed, self.folder)
        set_up_logging()
        hydra: Any = HydraConfig.instance().cfg
        # A job's files may say other things of Hydra than those that were looked at.
        check_composed(hydra, self.allowed)
        for_hydra, words = typed(hydra.hydra.overrides)
        (outcome,) = self.handle([ready_trial(look_at(config, self.allowed), [*for_hydra, *words])])
        if outcome.status == "failed":
            raise (InputError if outcome.bad_input else GsbenchError)(outcome.message)
        if hydra.hydra.mode == RunMode.RUN:
            self.outcomes.append(outcome)  # those of a sweep its launcher tells

    def launch(self, trials: Sequence[Trial]) -> None:
        """Run a batch of trials; raises GsbenchError where no other trial can succeed either."""
        self.trials += trials
        outcomes = self.handle(trials)
        if self.look_only:
            raise StopAfterListing
        self.outcomes += outcomes
        if fatal := next((outcome for outcome in outcomes if outcome.fatal), None):
            raise (InputError if fatal.bad_input else GsbenchError)(fatal.message)


def run_app(words: Sequence[str], multirun: bool, task: Task) -> None:
    """Run ``task`` for the trials of a command line: one, or many with ``multirun`` or an experiment that is a sweep.

    Raises InputError, one line, for what does not compose or hold together.
    """
    check_words(words)
    swept = [word for word in words if is_sweep(word)]
    with hydra_ready():
        config = compose_whole([*words, "hydra.mode=MULTIRUN"] if multirun else words)
        multirun = config.hydra.mode == RunMode.MULTIRUN
        if swept and not multirun:
            raise InputError(f"{swept[0]} lists several values: add -m to run one trial for each")
        with explained(words):
            check_hydra_settings(config, multirun)
        task.allowed = tuple(config[PERMISSIONS])
        task.grids = OmegaConf.to_container(config.hydra.sweeper, resolve=False).get("grids")  # type: ignore[union-attr]
        # Hydra would resolve ${…} in the grids when it makes the sweeper; there it is for each trial to do.
        chosen = [*words, *["hydra.sweeper.grids=[]"] * bool(task.grids)]
        trial = None if multirun else ready_trial(config, words)
        if task.look_only:
            try:
                _look(config, chosen, trial, task)
            except StopAfterListing:
                return
        task.trials += [] if trial is None else [trial]
        load_callbacks(config, task.allowed)
    with explained(words, (HydraException, OmegaConfBaseException, OSError)):  # such as of a folder for Hydra's files
        run_main(task, [*chosen, f"hydra.mode={(RunMode.MULTIRUN if multirun else RunMode.RUN).name}"], task.allowed)


def _look(config: DictConfig, words: Sequence[str], trial: Trial | None, task: Task) -> None:
    """Say what would run: a single trial, or those of a sweep as far as its sweeper knows; no callback hears of it."""
    if trial is not None:
        task.launch([trial])
    if task.grids:
        config = compose_whole([*words, "hydra.mode=MULTIRUN"])
    with explained(words):
        context = HydraContext(GlobalHydra.instance().config_loader(), None)  # type: ignore[arg-type]
        sweeper = Plugins.instance().instantiate_sweeper(hydra_context=context, task_function=task, config=config)
        sweeper.sweep(arguments=[word for word in words if not parse_word(word).is_hydra_override()])


def list_trials(trials: Sequence[Trial]) -> list[Outcome]:
    """Print the trials with their states, and what they will miss; run none."""
    if not need_no_check(trials):
        check_parts(trials, here=False)
    lines = describe_plan(trials, trials[0].values["launch"]["parallel"])
    print("\n".join([*lines, *missing_folders(trials)]))
    return []


def check_hydra_settings(config: DictConfig, multirun: bool) -> None:
    """Refuse of Hydra's own settings what cannot be, wherever it was said: on the command line or in a file."""
    hydra, launcher = config.hydra, config.hydra.runtime.choices["hydra/launcher"]
    if hydra.job.chdir:
        raise InputError(
            "hydra.job.chdir=true: trials run in the folder where the command was given, and paths start there; "
            "${hydra:runtime.output_dir} names Hydra's folder"
        )
    if not multirun and hydra.mode is None and (hydra.sweeper.get("params") or hydra.sweeper.get("grids")):
        raise InputError("hydra.sweeper lists values: add -m to run a trial for each, or hydra.mode=RUN for one")
    if not multirun and launcher != OWN:
        raise InputError(f"hydra/launcher={launcher} launches sweeps: add -m, or leave it out")
    params = hydra.sweeper.get("params")
    if params is not None and not OmegaConf.is_dict(params):
        raise InputError(
            f"hydra.sweeper.params={params} must map settings to their values; seed=0,1 can be typed itself"
        )
    if launcher != OWN and config.launch.name != "serial":
        raise InputError(f"hydra/launcher={launcher} and launch={config.launch.name} are two launchers: choose one")
    if multirun and launcher == OWN and (unread := _read_by_jobs_of_hydra(hydra)):
        raise InputError(f"{unread}: in a sweep only Hydra's own launcher reads it: add hydra/launcher=basic")
    if config.launch.stop_when_decided and not multirun:
        raise InputError("launch.stop_when_decided adds seeds to a sweep: add -m, two densifiers and seed=0,1,2,3")


def _read_by_jobs_of_hydra(hydra: DictConfig) -> str:
    """The first setting that acts where Hydra runs a job, which gsbench's launcher does not ask it to; "" for none."""
    raw: Any = OmegaConf.to_container(hydra, resolve=False)
    given = {
        "hydra.callbacks": raw["callbacks"],
        "hydra.job.env_set": raw["job"]["env_set"],
        "hydra.output_subdir": raw["output_subdir"],
        "hydra.sweep": raw["sweep"] != OWN_FOLDER,
    }
    return next((name for name, value in given.items() if value), "")


def summarize(outcomes: Sequence[Outcome], trials: Sequence[Trial]) -> int:
    """Say how the trials ended; 0 if all are done, 1 if some failed, 2 if all failed for bad input.

    A single trial's failure is raised, so that it is the one line that the program prints.
    """
    failed = [outcome for outcome in outcomes if outcome.status == "failed"]
    fatal = next((outcome for outcome in failed if outcome.fatal), None)
    if failed and (fatal or len(outcomes) == 1):
        worst = fatal or failed[0]
        raise (InputError if worst.bad_input else GsbenchError)(worst.message)
    for outcome in failed:
        print(f"gsbench: failed: {outcome.label}: {outcome.message}", file=sys.stderr)
    name = trials[-1].values["name"]  # a tuning comes before, in experiments of its own
    done = sum(outcome.status == "done" for outcome in outcomes)
    if any(outcome.status == "queued" for outcome in outcomes):
        advice = f"how far the others are: gsbench status {name}"
    else:
        advice = f"again: gsbench retry {name}" if failed else f"the table: gsbench tables {name}"
        if len(outcomes) == 1:
            advice += f"; renders and model: {outcomes[0].folder}"
    log.info("%d of %d trials done; %s", done, len(outcomes), advice)
    if failed and all(outcome.status == "failed" and outcome.bad_input for outcome in outcomes):
        return 2
    return 1 if failed else 0
