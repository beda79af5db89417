"""Plug-ins by which Hydra finds gsbench's launcher and sweeper; what they do stands in ``gsbench.app.sweep``.

Hydra imports this file at every start, of any Hydra app in the same environment, so it imports Hydra alone.
"""

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
    """Name for what gsbench's sweeper does by itself: to run all trials as the settings below ``launch`` say."""

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        pass

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        raise NotImplementedError


class GsbenchSweeper(Sweeper):
    """The grid of all listed values, or several joined, handed to the launcher as a whole.

    ``tune`` says how intervals are searched before that. What ``grids`` say is read before Hydra resolves it.
    """

    def __init__(self, params: dict[str, Any] | None, tune: dict[str, Any] | None = None, grids: Any = None) -> None:
        self.params, self.tune = params or {}, tune or {}

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        from gsbench.app.sweep import Sweep

        self.begun = Sweep.begin(hydra_context, task_function, config)

    def sweep(self, arguments: list[str]) -> None:
        self.begun.run(self.params, self.tune, arguments)


LAUNCHER = {"_target_": "hydra_plugins.gsbench.GsbenchLauncher"}
SWEEPER = {"_target_": "hydra_plugins.gsbench.GsbenchSweeper", "params": {}, "grids": []}
# as gsbench.app.tuning.TuneSettings
TUNE = {"points": 20, "at_once": 1, "metric": None, "seed": 100}
# Hydra imports this file more than once; from 1.4 on it says so unless it is told that the same may come again.
AGAIN: dict[str, Any] = {"replace": True} if "replace" in signature(ConfigStore.store).parameters else {}
for group, node in (("launcher", LAUNCHER), ("sweeper", {**SWEEPER, "tune": TUNE})):
    ConfigStore.instance().store(group=f"hydra/{group}", name="gsbench", node=node, provider="gsbench", **AGAIN)
