"""gsbench as a Hydra app: Hydra composes, its sweeper makes jobs of a command line, its launcher runs them.

`run_app` does what ``hydra.main`` does, step for step, but for three things: what comes back are errors of ours in one
line in place of Hydra's pages; the configuration is composed once, not three times, before the sweep; and where
trials are only listed, no callback hears of it.
"""

from __future__ import annotations

from collections.abc import Sequence

from hydra.core.plugins import Plugins
from hydra.types import HydraContext, RunMode
from omegaconf import DictConfig

from gsbench.app.grids import grids_aside
from gsbench.app.task import OWN, StopAfterListing, Task
from gsbench.config.command_words import check_words, is_sweep
from gsbench.config.compose import compose_master, composing, explained, ready_trial
from gsbench.config.hydra_guard import load_callbacks, make_callbacks
from gsbench.config.hydra_internals import Callbacks
from gsbench.config.hydra_job import (
    CONFIG_NAME,
    HydraJob,
    begin_sweep,
    check_output_folder,
    record_sweep,
    start,
    words_of,
)
from gsbench.errors import InputError
from gsbench.launch.outcome import Outcome
from gsbench.launch.trial import Trial
from gsbench.logs import show_details


def run_app(words: Sequence[str], multirun: bool, task: Task) -> None:
    """Run ``task`` for the trials of a command line: one, or many with ``multirun`` or an experiment that is a sweep.

    Raises InputError, one line, for what does not compose or hold together.
    """
    check_words(words)
    swept = [word for word in words if is_sweep(word)]
    with composing() as hydra:
        master = compose_master(hydra, words, RunMode.MULTIRUN if multirun or swept else RunMode.RUN)
        multirun = multirun or master.hydra.mode == RunMode.MULTIRUN
        if swept and not multirun:
            raise InputError(f"{swept[0]} lists several values: add -m to run one trial for each")
        with explained(words):
            _check(master, multirun, task.look_only)
        show_details(master.hydra.verbose)
        with explained(words):  # a callback that cannot be made
            if not task.look_only:
                load_callbacks(master)
            context = HydraContext(hydra.config_loader, Callbacks() if task.look_only else make_callbacks(master))
        try:
            (_multirun if multirun else _run)(context, start(master, RunMode(1 + multirun)), words, task)
        except StopAfterListing:
            return


def compose_trials(words: Sequence[str], multirun: bool = False) -> list[Trial]:
    """The trials that a command line would run."""

    task = Task(_stop_here, look_only=True)
    run_app(words, multirun, task)
    return task.trials


def _stop_here(trials: Sequence[Trial]) -> list[Outcome]:
    raise StopAfterListing


def _run(context: HydraContext, config: DictConfig, words: Sequence[str], task: Task) -> None:
    """As `hydra.run`, by way of the settings below ``launch``."""
    context.callbacks.on_run_start(config=config, config_name=CONFIG_NAME)
    job = HydraJob(config, tuple(words), callbacks=context.callbacks, loader=context.config_loader)
    (returned,) = task.launch([Trial.of(ready_trial(config, words, job))])
    context.callbacks.on_run_end(config=config, config_name=CONFIG_NAME, job_return=returned)


def _multirun(context: HydraContext, config: DictConfig, words: Sequence[str], task: Task) -> None:
    """As `hydra.multirun`."""
    with explained(words):
        begin_sweep(config)
        if not task.look_only:
            record_sweep(config)
    context.callbacks.on_multirun_start(config=config, config_name=CONFIG_NAME)
    with grids_aside(config) as task.grids, explained(words):  # a sweeper or launcher that cannot be made
        sweeper = Plugins.instance().instantiate_sweeper(hydra_context=context, task_function=task, config=config)
    sweeper.sweep(arguments=words_of(config.hydra.overrides)[1])
    context.callbacks.on_multirun_end(config=config, config_name=CONFIG_NAME)


def _check(master: DictConfig, multirun: bool, look_only: bool) -> None:
    """Refuse of Hydra's own settings what cannot be, wherever it was said: on the command line or in a file."""
    hydra, choices = master.hydra, master.hydra.runtime.choices
    launcher, sweeper = choices["hydra/launcher"], choices["hydra/sweeper"]
    if hydra.job.chdir:
        raise InputError(
            "hydra.job.chdir=true: trials run where the command was given, from where paths are meant; "
            "${hydra:runtime.output_dir} names Hydra's folder"
        )
    if not multirun and hydra.mode is None and (hydra.sweeper.get("params") or hydra.sweeper.get("grids")):
        raise InputError("hydra.sweeper lists values: add -m to run a trial for each, or hydra.mode=RUN for one")
    if not multirun and launcher != OWN:
        raise InputError(f"hydra/launcher={launcher} launches sweeps: add -m, or leave it out")
    if launcher != OWN and master.launch.name != "serial":
        raise InputError(f"hydra/launcher={launcher} and launch={master.launch.name} are two launchers: choose one")
    if not look_only:
        check_output_folder(master, multirun)
    if look_only and launcher != OWN and sweeper != OWN:
        raise InputError(f"hydra/sweeper={sweeper} does not say beforehand what hydra/launcher={launcher} will run")
    if master.launch.stop_when_decided and not multirun:
        raise InputError("launch.stop_when_decided adds seeds to a sweep: add -m, two densifiers and seed=0,1,2,3")
    if master.launch.stop_when_decided and sweeper != OWN:
        raise InputError(
            f"hydra/sweeper={sweeper} chooses by itself what to run: leave it or launch.stop_when_decided out"
        )
    if sweeper != OWN and not master.launch.wait:
        raise InputError(f"hydra/sweeper={sweeper} learns from results, so launch.wait must be true")
