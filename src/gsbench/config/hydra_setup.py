"""Hydra, set up with gsbench's files: what may be called while it is initialised."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from typing import Any

import hydra
from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from gsbench.config.schema import register_schemas
from gsbench.system.install import conf_dir

CONFIG_NAME = "config"  # conf/config.yaml
# Hydra 1.3 warns unless it is told which version's defaults hold; Hydra 1.4 has one set and warns
# if it is told.
VERSION_BASE: dict[str, Any] = (
    {"version_base": "1.3"} if hydra.__version__.startswith("1.3.") else {}
)


@cache
def installed_nodes(choices: tuple[str, ...]) -> Mapping[str, Any]:
    """Hydra's node for ``choices`` of plug-ins and logs, from installed packages only.

    It includes what gsbench's own ``conf/config.yaml`` sets. Choices that only a user's folder has
    are left out.
    """
    with hydra_ready():
        known = [
            word
            for word in choices
            if word.partition("=")[2] in config_loader().get_group_options(word.partition("=")[0])
        ]
    node: Any = OmegaConf.to_container(composed_once(tuple(known)).hydra, resolve=False)
    return node  # type: ignore[no-any-return]


@cache
def composed_once(words: tuple[str, ...]) -> DictConfig:
    """Hydra's composition of ``words``, with its node; do not change it.

    Only for words that name no folder of the user's: gsbench's own files stay as they are while a
    process runs.
    """
    with hydra_ready():  # composing takes 0.1 s
        return hydra.compose(CONFIG_NAME, list(words), return_hydra_config=True)


@contextmanager
def hydra_ready() -> Iterator[None]:
    """Initialise Hydra with gsbench's configuration folder within the block."""
    register_schemas()
    if GlobalHydra.instance().is_initialized():  # within `hydra.main`, or in a block of this kind
        yield
        return
    with hydra.initialize_config_dir(str(conf_dir()), job_name="gsbench", **VERSION_BASE):
        yield


def config_loader() -> ConfigLoader:
    """Hydra's loader of configurations. Call it within `hydra_ready`."""
    return GlobalHydra.instance().config_loader()


@contextmanager
def hydra_config(config: DictConfig | None) -> Iterator[None]:
    """Let ``${hydra:…}`` read the node of ``config`` within the block; with None it is an error."""
    instance = HydraConfig.instance()
    before, instance.cfg = instance.cfg, None
    try:
        if config is not None:
            instance.set_config(config)
        yield
    finally:
        instance.cfg = before
