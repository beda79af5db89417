"""Running `hydra.main`, and the files that Hydra writes.

Below the runs folder, which may be a stranger's, Hydra's files lie in `FOLDER`: no link there is
followed, and no result of a job is read from a place that somebody could have prepared.
"""

import logging
import os
import secrets
import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext, redirect_stderr
from pathlib import Path
from typing import Any
from unittest.mock import patch

import hydra
import hydra.utils
from omegaconf import DictConfig, OmegaConf

from gsbench.app.sweep import BASIC, OWN, Sweep
from gsbench.config.compose import CONFIG_NAME, VERSION_BASE, hydra_config, installed_nodes
from gsbench.config.overrides import key_of
from gsbench.config.schema import register_schemas
from gsbench.config.trust import ALLOWED, load_callbacks
from gsbench.errors import InputError
from gsbench.runs.configuration import targets_in
from gsbench.system.install import conf_dir

FOLDER = ".hydra"  # below the runs folder
HYDRAS_FILES = ("run", "sweep", "output_subdir")  # settings of Hydra's own files
SWEEP_DIR = "hydra.sweep.dir"
HYDRAS_LINE = "Error executing job with overrides"
# Within this context, Hydra 1.4 and later instantiates only the named classes (``mine.*``: all of a
# module).
WHITELIST: Callable[[Sequence[str]], AbstractContextManager[Any]] = getattr(
    hydra.utils, "execution_whitelist", lambda names: nullcontext()
)

log = logging.getLogger(__name__)


def words_for_files(config: DictConfig, words: Sequence[str], multirun: bool) -> list[str]:
    """The words by which Hydra writes its own files as in any app, if one of them was asked for.

    Otherwise Hydra writes nothing, since each trial's folder has its configuration and log.
    """
    node, usual = (OmegaConf.to_container(config.hydra, resolve=False), installed_nodes(()))
    assert isinstance(node, dict)
    logs = node["job_logging"].get("root")
    if not logs and all(node[key] == usual[key] for key in HYDRAS_FILES):
        return []
    typed = {key_of(word) for word in words}
    added = {}
    if node["output_subdir"] is None and "hydra.output_subdir" not in typed:
        added["hydra.output_subdir"] = ".hydra"
    if not logs and "hydra/job_logging" not in typed:
        added |= {"hydra/job_logging": "default", "hydra.job_logging.root.handlers": "[file]"}
    if node["run"] == usual["run"]:
        added["hydra.run.dir"] = f"${{runs}}/{FOLDER}"
    if multirun and node["sweep"]["subdir"] == usual["sweep"]["subdir"]:
        added["hydra.sweep.subdir"] = "${hydra.job.num}"
    if (
        multirun
        and config.hydra.runtime.choices["hydra/launcher"] == OWN
        and (config.launch.name != "serial")
    ):
        log.info(
            "launch=%s writes no files of Hydra's: each trial's folder has them",
            config.launch.name,
        )
    return [f"{key}={value}" for key, value in added.items()]


def words_for_new_folder(sweep: Sweep) -> list[str]:
    """The word that gives another launcher a new folder, whose name nobody could guess.

    Its jobs' results are unpickled from there (submitit: the first file with the number of a
    process), and somebody's runs folder could have such files for all numbers. Raises InputError
    if a folder that the user typed has some already.
    """
    config = sweep.config
    if config.hydra.runtime.choices["hydra/launcher"] in (OWN, BASIC):  # read no files
        return []
    if SWEEP_DIR not in map(key_of, sweep.words):
        return [f"{SWEEP_DIR}=${{runs}}/{FOLDER}/{secrets.token_hex(8)}"]
    launcher = OmegaConf.to_container(config.hydra.launcher, resolve=False)
    for value in launcher.values() if isinstance(launcher, dict) else ():
        start, found, rest = str(value).partition(f"${{{SWEEP_DIR}}}/")
        place = Path(config.hydra.sweep.dir, rest.partition("%")[0])
        if found and not start and place.exists():
            raise InputError(
                f"{place} is there already, and results of jobs would be unpickled from it: remove "
                f"it, or leave {SWEEP_DIR} out"
            )
    return []


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
        own = [f"hydra_plugins.gsbench.Gsbench{plugin}" for plugin in ("Launcher", "Sweeper")]
        names = [*own, *config.allow_targets, *(target for _, target in targets_in(nodes))]
    names = [name for name in names if all(part.isidentifier() for part in name.split("."))]
    register_schemas()
    with (
        # else Hydra prints errors and ends the process
        patch.dict(os.environ, HYDRA_FULL_ERROR="1"),
        WHITELIST([*ALLOWED["callbacks"], *names, *(f"{name}.*" for name in names)]),
        redirect_stderr(_WithoutHydrasLine(sys.stderr)),
        hydra_config(None),
        patch.object(sys, "argv", ["gsbench", *argv]),
    ):
        hydra.main(**VERSION_BASE, config_path=str(conf_dir()), config_name=CONFIG_NAME)(task)()


class _WithoutHydrasLine:
    """Standard error without Hydra's line about a job's error, which gsbench prints itself."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        return len(text) if text.startswith(HYDRAS_LINE) else int(self._stream.write(text))
