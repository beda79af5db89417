"""By these names Hydra finds gsbench's launcher and sweeper; what they do stands in ``gsbench.launch``.

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
    """Gets all trials of a sweep at once, and runs them as the settings below ``launch`` say."""

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        self.context, self.task, self.config = hydra_context, task_function, config

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        from gsbench.launch.task import launch_jobs

        return launch_jobs(self.task, self.context, self.config, job_overrides, initial_job_idx)


class GsbenchSweeper(Sweeper):
    """The grid of all listed values, or several joined, handed to the launcher as a whole."""

    def __init__(self, params: dict[str, Any]) -> None:
        self.params = params

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        from hydra.core.plugins import Plugins

        self.context, self.task, self.config = hydra_context, task_function, config
        self.launcher = Plugins.instance().instantiate_launcher(
            hydra_context=hydra_context, task_function=task_function, config=config
        )

    def sweep(self, arguments: list[str]) -> Sequence[JobReturn]:
        from gsbench.launch.task import sweep

        return sweep(self.task, self.context, self.config, self.launcher, self.params, arguments)


LAUNCHER = {"_target_": "hydra_plugins.gsbench.GsbenchLauncher"}
SWEEPER = {"_target_": "hydra_plugins.gsbench.GsbenchSweeper", "params": {}, "grids": []}
ConfigStore.instance().store(group="hydra/launcher", name="gsbench", node=LAUNCHER, provider="gsbench")
ConfigStore.instance().store(group="hydra/sweeper", name="gsbench", node=SWEEPER, provider="gsbench")
