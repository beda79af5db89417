"""Choices that were moved to another name: Hydra still finds them by the old one, wherever it stands, and says a word.

They are listed nowhere, so that ``glob(*)`` and completion know new names only.
"""

from __future__ import annotations

import logging
from typing import Any

from hydra.core.config_search_path import SearchPathQuery
from hydra.core.object_type import ObjectType
from hydra.plugins.config_source import ConfigResult, ConfigSource
from omegaconf import OmegaConf

from gsbench.config.hydra_internals import SourcesRegistry

log = logging.getLogger(__name__)

SCHEME = "gsbench-old-names"
RENAMED = {  # a path below conf/: the new one
    "densify/external": "densify/external/program",
    "densify/3dgs": "densify/external/3dgs",
    "densify/brush": "densify/external/brush",
    "densify/gsplat": "densify/external/gsplat",
    "densify/nerfstudio": "densify/external/nerfstudio",
    "densify/opensplat": "densify/external/opensplat",
}
_told: set[str] = set()  # by this process


def as_word(path: str) -> str:
    """``densify=3dgs`` for densify/3dgs."""
    group, _, name = path.partition("/")
    return f"{group}={name}"


class OldNames(ConfigSource):
    """Files that hold nothing but the new name."""

    @staticmethod
    def scheme() -> str:
        return SCHEME

    def load_config(self, config_path: str) -> ConfigResult:
        new = RENAMED[config_path]
        if config_path not in _told:
            _told.add(config_path)
            log.warning("%s is called %s now; the old name still works", as_word(config_path), as_word(new))
        config = OmegaConf.create({"defaults": [f"/{new}@_here_", "_self_"]})
        header: dict[str, str | None] = {"package": None}
        return ConfigResult(SCHEME, config_path, config, header)

    def is_group(self, config_path: str) -> bool:
        return False

    def is_config(self, config_path: str) -> bool:
        return config_path in RENAMED

    def available(self) -> bool:
        return True

    def list(self, config_path: str, results_filter: ObjectType | None) -> list[str]:
        return []


def know_old_names(loader: Any) -> None:
    """Let a config loader of Hydra's find old names where it finds nothing of gsbench's own."""
    SourcesRegistry.instance().register(OldNames)
    path = loader.get_search_path()
    path.append("gsbench", f"{SCHEME}://", SearchPathQuery(provider="main"))
    loader.repository.initialize_sources(path)
