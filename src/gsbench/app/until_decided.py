"""``launch.stop_when_decided=true``: a sweep in planned looks, by any launcher that waits for what it runs."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from hydra.core.utils import JobReturn
from hydra.plugins.launcher import Launcher
from omegaconf import DictConfig

from gsbench.app.task import Task, launch_trials
from gsbench.claims.stopping import headline, plan_sweep
from gsbench.claims.sweep import run_looks
from gsbench.files import checked_runs_folder, make_runs_folder
from gsbench.launch.declare import declare_plan
from gsbench.launch.trial import Trial

log = logging.getLogger(__name__)


def sweep_until_decided(
    task: Task, master: DictConfig, launcher: Launcher, trials: Sequence[Trial]
) -> Sequence[JobReturn]:
    """Run the trials of a sweep seed by seed, and no further ones of pairs of arms that are decided.

    Raises InputError for a sweep that cannot be looked at so.
    """
    stopping = plan_sweep(trials)
    if task.look_only:
        print(stopping.describe())
        return task.launch(trials)
    make_runs_folder(checked_runs_folder(trials[0].values["runs"]))
    declared = declare_plan(stopping.home, stopping.plan.to_record(), stopping.hash)
    returned: list[JobReturn] = []
    launched: set[Path] = set()

    def run(batch: Sequence[Trial]) -> None:
        launched.update(trial.folder for trial in batch)
        returned.extend(launch_trials(task, master, launcher, batch, first=len(returned)))

    verdicts = run_looks(stopping, declared, run, lambda trial: trial.folder in launched)
    for verdict in verdicts:
        log.info("%s", headline(verdict))
    log.info("%d of %d trials were not needed", len(stopping.by_folder) - len(launched), len(stopping.by_folder))
    return returned
