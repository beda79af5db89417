"""Plug-ins by which Hydra hands trials to gsbench; ``gsbench.app.plugins`` does their work.

Hydra imports this file whenever any Hydra app in the same environment starts, so it imports only
Hydra.
"""

from collections.abc import Sequence
from typing import Any

from hydra.core.utils import JobReturn
from hydra.plugins.launcher import Launcher
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig


class GsbenchLauncher(Launcher):
    """Runs the jobs of another sweeper as the settings ``launch`` say.

    gsbench's own sweeper runs its trials itself.
    """

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        self.task: Any = task_function
        self.config = config

    def launch(
        self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
    ) -> Sequence[JobReturn]:
        returned: Sequence[JobReturn] = self.task.run_jobs(job_overrides, self.config)
        return returned


class GsbenchSweeper(Sweeper):
    """Runs the grid of all listed values, or several joined grids, as one batch.

    gsbench has read its settings before Hydra makes this object.
    """

    def __init__(self, **settings: Any) -> None:
        pass

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        self.task: Any = task_function
        self.context, self.config = hydra_context, config

    def sweep(self, arguments: list[str]) -> None:
        self.task.run_sweep(self.context, self.config)
