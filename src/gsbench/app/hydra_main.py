"""Starting `hydra.main`: for plug-ins of Hydra's, and for its own questions (``--cfg``)."""

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, redirect_stderr
from typing import Any

import hydra
import hydra.utils
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from gsbench.config.hydra_setup import CONFIG_NAME, VERSION_BASE
from gsbench.config.schema import register_schemas
from gsbench.config.trust import HYDRAS_CALLBACKS, load_callbacks
from gsbench.runs.nested import targets_in
from gsbench.system.install import conf_dir

HYDRAS_LINE = "Error executing job with overrides"
# Within this context, Hydra 1.4 and later instantiates only the named classes (``mine.*``: all of a
# module).
WHITELIST: Callable[[Sequence[str]], AbstractContextManager[Any]] = getattr(
    hydra.utils, "execution_whitelist", lambda names: nullcontext()
)


def run_main(
    task: Callable[[Any], Any], argv: Sequence[str], config: DictConfig | None = None
) -> None:
    """Run ``task`` as an app of ``hydra.main`` with the words ``argv``; raises what it raises.

    Hydra may instantiate its own callbacks, the plug-ins that the checked ``config`` chooses, and
    the classes that it allows.
    """
    names: list[str] = []
    if config is not None:
        load_callbacks(config.hydra.callbacks, config.allow_targets)
        plugins = [config.hydra.launcher, config.hydra.sweeper]
        nodes = [OmegaConf.to_container(node, resolve=False) for node in plugins]
        names = [*config.allow_targets, *(target for _, target in targets_in(nodes))]
    names = [name for name in names if all(part.isidentifier() for part in name.split("."))]
    register_schemas()
    with (
        WHITELIST([*HYDRAS_CALLBACKS, *names, *(f"{name}.*" for name in names)]),
        redirect_stderr(_WithoutHydrasLine(sys.stderr)),
        _as_program(["gsbench", *argv]),
    ):
        hydra.main(**VERSION_BASE, config_path=str(conf_dir()), config_name=CONFIG_NAME)(task)()


@contextmanager
def _as_program(argv: list[str]) -> Iterator[None]:
    """Let Hydra read ``argv``, and raise errors instead of printing them and ending the process."""
    saved = sys.argv, os.environ.get("HYDRA_FULL_ERROR")
    sys.argv, os.environ["HYDRA_FULL_ERROR"] = argv, "1"
    try:
        yield
    finally:
        sys.argv = saved[0]
        os.environ.pop("HYDRA_FULL_ERROR")
        if saved[1] is not None:
            os.environ["HYDRA_FULL_ERROR"] = saved[1]
        HydraConfig.instance().cfg = None


class _WithoutHydrasLine:
    """Standard error without Hydra's line about a job's error, which gsbench prints itself."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        return len(text) if text.startswith(HYDRAS_LINE) else int(self._stream.write(text))
