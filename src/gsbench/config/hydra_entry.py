"""Hydra's two entrances: composing a configuration, and running an app."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

import hydra
import hydra.utils
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig

from gsbench.config.schema import register_schemas
from gsbench.config.trust import HYDRAS_CALLBACKS
from gsbench.system.install import conf_dir

CONFIG_NAME = "config"  # conf/config.yaml
# Hydra 1.3 wants to be told whose defaults hold; from 1.4 on there is one set of them, and being told is warned of.
VERSION_BASE: dict[str, Any] = {"version_base": "1.3"} if hydra.__version__.startswith("1.3.") else {}
# From 1.4 on Hydra makes objects within this context of the named classes alone (``mine.*``: all of a module).
WHITELIST: Callable[[Sequence[str]], AbstractContextManager[Any]] = getattr(
    hydra.utils, "execution_whitelist", lambda names: nullcontext()
)
HYDRAS_LINE = "Error executing job with overrides"


@contextmanager
def hydra_ready() -> Iterator[None]:
    """Hydra with gsbench's folder of configurations; where an app of Hydra's runs, it is so already."""
    register_schemas()
    if GlobalHydra.instance().is_initialized():
        yield
        return
    try:
        with hydra.initialize_config_dir(str(conf_dir()), job_name="gsbench", **VERSION_BASE):
            yield
    finally:
        HydraConfig.instance().cfg = None


def run_main(task: Callable[[Any], Any], argv: Sequence[str], allowed: Sequence[str] = ()) -> None:
    """Run ``task`` as the app that ``hydra.main`` makes of it, with the words ``argv``; raises what it raises.

    The classes of callbacks are those that ``allowed`` names, and Hydra's own.
    """
    names = [name for name in allowed if all(part.isidentifier() for part in name.split("."))]
    register_schemas()
    saved, sys.argv = sys.argv, ["gsbench", *argv]
    full = os.environ.get("HYDRA_FULL_ERROR")
    os.environ["HYDRA_FULL_ERROR"] = "1"  # else Hydra prints errors itself, and exits
    stderr, sys.stderr = sys.stderr, _WithoutHydrasLine(sys.stderr)
    try:
        with WHITELIST([*HYDRAS_CALLBACKS, *names, *(f"{name}.*" for name in names)]):
            hydra.main(**VERSION_BASE, config_path=str(conf_dir()), config_name=CONFIG_NAME)(task)()
    finally:
        sys.argv, sys.stderr = saved, stderr
        os.environ.pop("HYDRA_FULL_ERROR")
        if full is not None:
            os.environ["HYDRA_FULL_ERROR"] = full
        HydraConfig.instance().cfg = None


class _WithoutHydrasLine:
    """Standard error without the line that Hydra writes before it hands on a job's error, which we say ourselves."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        return len(text) if text.startswith(HYDRAS_LINE) else int(self._stream.write(text))
