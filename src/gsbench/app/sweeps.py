"""The work of gsbench's sweeper: all points of its grids at once, or seed by seed until their question is decided.

Either may begin by tuning its arms.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.utils import JobReturn
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext
from omegaconf import DictConfig

from gsbench.app.grids import words_of_grids
from gsbench.app.task import Task, grid, launch_trials, trials_of_jobs
from gsbench.app.tuning import tuned_jobs
from gsbench.claims.stopping import headline, plan_sweep
from gsbench.claims.sweep import run_looks
from gsbench.config.compose import explained
from gsbench.files import checked_runs_folder, make_runs_folder
from gsbench.launch.declare import declare, declare_plan, declared_metrics, planned_trials
from gsbench.launch.trial import Trial
from gsbench.runs.layout import RESULTS

log = logging.getLogger(__name__)


def sweep(
    task: Task,
    context: HydraContext,
    master: DictConfig,
    launcher: Launcher,
    params: Mapping[str, Any],
    tune: Mapping[str, Any],
    words: Sequence[str],
) -> Sequence[JobReturn]:
    """Run all points that the words of a sweep span; ``params`` are the settings and values of
    ``hydra.sweeper.params``, ``tune`` says what of the arms is tuned before (`gsbench.app.tuning`).
    """
    parser = OverridesParser.create(context.config_loader)
    with explained(words):
        jobs = [
            point
            for of_grid in words_of_grids(params, task.grids, words)
            for point in grid(parser.parse_overrides(of_grid))
        ]
    if any(value not in (None, {}) for key, value in tune.items() if key in ("points", "ranges")):
        jobs = tuned_jobs(task, context, master, launcher, tune, jobs)
    trials = trials_of_jobs(context, master, jobs)
    until_decided = any(trial.values["launch"]["stop_when_decided"] for trial in trials)
    return (run_until_decided if until_decided else launch_trials)(task, master, launcher, trials)


def run_until_decided(
    task: Task, master: DictConfig, launcher: Launcher, trials: Sequence[Trial]
) -> Sequence[JobReturn]:
    """Run the trials of a sweep in planned looks, and no further ones of pairs of arms that are decided.

    The launcher must wait for what it runs.

    Raises InputError for a sweep that cannot be looked at so.
    """
    stopping = plan_sweep(trials)
    if task.look_only:
        print(stopping.describe())
        return task.launch(trials)
    make_runs_folder(checked_runs_folder(trials[0].values["runs"]))
    declared = declare_plan(stopping.home, stopping.plan.to_record(), stopping.hash)
    declare(declared_metrics(trials), planned_trials(trials))  # all at once: what a look adds was planned
    returned: list[JobReturn] = []
    launched: set[Path] = set()

    def run(batch: Sequence[Trial]) -> None:
        launched.update(trial.folder for trial in batch)
        returned.extend(launch_trials(task, master, launcher, batch, first=len(returned)))

    verdicts = run_looks(stopping, declared, run, lambda trial: trial.folder in launched)
    for verdict in verdicts:
        log.info("%s", headline(verdict))
    spared = [trial for trial in trials if trial.folder not in launched and not (trial.folder / RESULTS).exists()]
    log.info("%d of %d trials were not needed", len(spared), len(trials))
    return returned
