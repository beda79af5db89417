"""Plug-ins by which Hydra finds gsbench's launcher and sweepers; what they do stands in ``gsbench.launch``.

Hydra imports this file at every start, of any Hydra app in the same environment, so it imports Hydra alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from hydra.core.config_store import ConfigStore
from hydra.core.utils import JobReturn
from hydra.plugins.launcher import Launcher
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig


class GsbenchLauncher(Launcher):
    """Launcher that gets all trials of a sweep at once, and runs them as the settings below ``launch`` say."""

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        self.context, self.task, self.config = hydra_context, task_function, config

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        from gsbench.app.task import launch_jobs

        return launch_jobs(self.task, self.context, self.config, job_overrides, initial_job_idx)


class GsbenchSweeper(Sweeper):
    """The grid of all listed values, or several joined, handed to the launcher as a whole.

    ``tune`` says what of each arm is tuned before that.
    """

    def __init__(self, params: dict[str, Any], tune: dict[str, Any] | None = None) -> None:
        self.params, self.tune = params, tune or {}

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        from hydra.core.plugins import Plugins

        self.context, self.task, self.config = hydra_context, task_function, config
        self.launcher = Plugins.instance().instantiate_launcher(
            hydra_context=hydra_context, task_function=task_function, config=config
        )

    def sweep(self, arguments: list[str]) -> Any:
        from gsbench.app.sweeps import sweep

        return sweep(self.task, self.context, self.config, self.launcher, self.params, self.tune, arguments)


class OptunaSweeper(GsbenchSweeper):
    """The points that Optuna proposes, learning from those before."""

    def __init__(self, params: dict[str, Any], **settings: Any) -> None:
        super().__init__(params)
        self.settings = settings

    def sweep(self, arguments: list[str]) -> None:
        from gsbench.app.search import search

        words = [*(f"{key}={value}" for key, value in self.params.items()), *arguments]
        search(self.task, self.context, self.config, self.launcher, self.settings, words)


LAUNCHER = {"_target_": "hydra_plugins.gsbench.GsbenchLauncher"}
SWEEPER = {"_target_": "hydra_plugins.gsbench.GsbenchSweeper", "params": {}, "grids": []}
# gsbench.app.tuning
TUNE = {"points": None, "metric": None, "direction": None, "seed": 100, "ranges": {}}
SEARCH = {  # gsbench.app.search; the last two are other names of n_trials and n_jobs
    **{"metric": "psnr", "direction": None, "n_trials": 20, "n_jobs": 1, "seed": 0, "params": {}},
    **{"trials": None, "at_once": None},
}
ConfigStore.instance().store(group="hydra/launcher", name="gsbench", node=LAUNCHER, provider="gsbench")
ConfigStore.instance().store(group="hydra/sweeper", name="gsbench", node={**SWEEPER, "tune": TUNE}, provider="gsbench")
ConfigStore.instance().store(
    group="hydra/sweeper",
    name="optuna",
    node={"_target_": "hydra_plugins.gsbench.OptunaSweeper", **SEARCH},
    provider="gsbench",
)
