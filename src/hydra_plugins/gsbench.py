"""Plug-ins by which Hydra finds gsbench's launcher and sweepers; what they do stands in ``gsbench.launch``.

Hydra imports this file at every start, of any Hydra app in the same environment, so it imports Hydra alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from inspect import signature
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
        from gsbench.config.jobs import JobContext

        self.context = JobContext(hydra_context.config_loader, hydra_context.callbacks)
        self.task, self.config = task_function, config

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        from gsbench.app.sweep import trials_of_jobs

        trials = trials_of_jobs(self.task, self.context, self.config, job_overrides, initial_job_idx)
        return self.task.launch(trials)  # type: ignore[attr-defined,no-any-return] # a Task of gsbench.app.command


class GsbenchSweeper(Sweeper):
    """The grid of all listed values, or several joined, handed to the launcher as a whole.

    ``tune`` says how intervals are searched before that. What ``grids`` say is read before Hydra resolves it.
    """

    def __init__(self, params: dict[str, Any] | None, tune: dict[str, Any] | None = None, grids: Any = None) -> None:
        self.params, self.tune = params or {}, tune or {}

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        from gsbench.app.sweep import Sweep

        self.begun = Sweep.begin(hydra_context, task_function, config)

    def sweep(self, arguments: list[str]) -> Any:
        return self.begun.run(self.params, self.tune, arguments)


LAUNCHER = {"_target_": "hydra_plugins.gsbench.GsbenchLauncher"}
SWEEPER = {"_target_": "hydra_plugins.gsbench.GsbenchSweeper", "params": {}, "grids": []}
# as gsbench.app.tuning.TuneSettings
TUNE = {"points": 20, "at_once": 1, "metric": None, "direction": None, "seed": 100}
# Hydra imports this file more than once; from 1.4 on it says so unless it is told that the same may come again.
AGAIN: dict[str, Any] = {"replace": True} if "replace" in signature(ConfigStore.store).parameters else {}
for group, node in (("launcher", LAUNCHER), ("sweeper", {**SWEEPER, "tune": TUNE})):
    ConfigStore.instance().store(group=f"hydra/{group}", name="gsbench", node=node, provider="gsbench", **AGAIN)
