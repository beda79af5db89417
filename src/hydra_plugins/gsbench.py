"""Plug-ins by which Hydra finds gsbench's launcher and sweeper; ``gsbench.app`` does their work.

Hydra imports this file whenever any Hydra app in the same environment starts, so it imports only
Hydra.
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
    """Runs the jobs of another sweeper as the settings ``launch`` say.

    gsbench's own sweeper runs its trials itself.
    """

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        self.loader = hydra_context.config_loader
        self.task, self.config = task_function, config

    def launch(
        self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
    ) -> Sequence[JobReturn]:
        from gsbench.app.sweep import Sweep

        return Sweep(self.config, self.task, self.loader).run_jobs(job_overrides)


class GsbenchSweeper(Sweeper):
    """Runs the grid of all listed values, or several joined grids, as one batch.

    ``tune`` says how intervals are searched first. ``grids`` is always empty here: gsbench reads
    the grids before Hydra makes this object, because Hydra would resolve them.
    """

    def __init__(
        self, params: dict[str, Any] | None, tune: dict[str, Any] | None = None, grids: Any = None
    ) -> None:
        self.params, self.tune = params or {}, tune or {}

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        from gsbench.app.sweep import Sweep

        self.started = Sweep.begin(hydra_context, task_function, config)

    def sweep(self, arguments: list[str]) -> None:
        from gsbench.app.grids import run_sweep

        run_sweep(self.started, self.params, self.tune, arguments)


LAUNCHER = {"_target_": "hydra_plugins.gsbench.GsbenchLauncher"}
SWEEPER = {"_target_": "hydra_plugins.gsbench.GsbenchSweeper", "params": {}, "grids": []}
# The defaults of gsbench.app.tuning.TuneSettings, which cannot be imported here.
TUNE = {"points": 20, "at_once": 1, "metric": None, "seed": 100}
# Hydra imports this file more than once. From 1.4 on it warns of that unless ``replace`` is set.
REPLACE: dict[str, Any] = (
    {"replace": True} if "replace" in signature(ConfigStore.store).parameters else {}
)
for group, node in (("launcher", LAUNCHER), ("sweeper", {**SWEEPER, "tune": TUNE})):
    ConfigStore.instance().store(
        group=f"hydra/{group}", name="gsbench", node=node, provider="gsbench", **REPLACE
    )
