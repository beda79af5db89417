"""Plug-ins by which Hydra hands trials to gsbench; ``gsbench.app.hydra_app`` does their work.

Hydra imports this file whenever any Hydra app in the same environment starts, so it imports only
Hydra.
"""

from collections.abc import Sequence
from typing import Any

from hydra.core.object_type import ObjectType
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn
from hydra.plugins.config_source import ConfigResult, ConfigSource
from hydra.plugins.launcher import Launcher
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig


class _Plugin:
    """The part that launcher and sweeper share. gsbench has read their settings before."""

    def __init__(self, **settings: Any) -> None:
        pass

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        self.task: Any = task_function
        self.context, self.config = hydra_context, config


class GsbenchLauncher(_Plugin, Launcher):
    """Runs the jobs of another sweeper as the settings ``launch`` say, or by another launcher.

    gsbench's own sweeper runs its trials itself.
    """

    def launch(
        self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
    ) -> Sequence[JobReturn]:
        returned: Sequence[JobReturn] = self.task.run_jobs(job_overrides, self.context, self.config)
        return returned


class GsbenchSweeper(_Plugin, Sweeper):
    """Runs the grid of all listed values, or several joined grids, as one batch."""

    def sweep(self, arguments: list[str]) -> None:
        self.task.run_sweep(self.context, self.config)


class GsbenchFiles(ConfigSource):
    """A folder of the user's as Hydra reads it, whose files gsbench checks first.

    Its place in the search path is ``gsbench://FOLDER``.
    """

    def __init__(self, provider: str, path: str) -> None:
        super().__init__(provider, path)
        sources: Any = Plugins.instance().discover(ConfigSource)
        (files,) = (source for source in sources if source.scheme() == "file")
        self.files: ConfigSource = files(provider, f"file://{self.path}")

    @staticmethod
    def scheme() -> str:
        return "gsbench"

    def load_config(self, config_path: str) -> ConfigResult:
        from gsbench.config.search_path import check_file

        check_file(self.path, config_path)
        return self.files.load_config(config_path)

    def is_group(self, config_path: str) -> bool:
        return self.files.is_group(config_path)

    def is_config(self, config_path: str) -> bool:
        return self.files.is_config(config_path)

    def available(self) -> bool:
        return self.files.available()

    def list(self, config_path: str, results_filter: ObjectType | None) -> list[str]:
        return self.files.list(config_path, results_filter)
