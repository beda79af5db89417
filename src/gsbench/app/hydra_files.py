"""The files that Hydra and its launchers write, and the words that say where.

Below the runs folder, which may be a stranger's, they lie in `FOLDER`: no link there is followed,
and no result of a job is read from a place that somebody could have prepared.
"""

import logging
import secrets
from collections.abc import Sequence
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from gsbench.app.sweep import OWN
from gsbench.config.hydra_setup import installed_nodes
from gsbench.config.overrides import key_of
from gsbench.errors import InputError
from gsbench.launch.jobs import check_job_links

FOLDER = ".hydra"  # below the runs folder
IN_PROCESS = (OWN, "basic")  # launchers that read no results from files
WRITTEN = ("run", "sweep", "output_subdir")  # settings of Hydra's own files
SWEEP_DIR = "hydra.sweep.dir"

log = logging.getLogger(__name__)


def words_for_hydras_files(config: DictConfig, words: Sequence[str], multirun: bool) -> list[str]:
    """The words by which Hydra writes its own files as in any app, if one of them was asked for.

    Otherwise Hydra writes nothing, since each trial's folder has its configuration and log.
    """
    node, usual = (OmegaConf.to_container(config.hydra, resolve=False), installed_nodes(()))
    assert isinstance(node, dict)
    logs = node["job_logging"].get("root")
    if not logs and all(node[key] == usual[key] for key in WRITTEN):
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
    if multirun and config.hydra.runtime.choices["hydra/launcher"] == OWN:
        if config.launch.name == "serial":
            # runs one job after the other, with Hydra's files for each
            added["hydra/launcher"] = "basic"
        else:
            log.info(
                "launch=%s writes no files of Hydra's: each trial's folder has them",
                config.launch.name,
            )
    return [f"{key}={value}" for key, value in added.items()]


def words_for_new_folder(config: DictConfig, words: Sequence[str]) -> list[str]:
    """The word that gives another launcher a new folder, whose name nobody could guess.

    Its jobs' results are unpickled from there (submitit: the first file with the number of a
    process), and somebody's runs folder could have such files for all numbers. Raises InputError
    if a folder that the user typed has some already.
    """
    if config.hydra.runtime.choices["hydra/launcher"] in IN_PROCESS:
        return []
    if SWEEP_DIR not in map(key_of, words):
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


def check_links(runs: Path) -> None:
    """Raise InputError for a link in the place of Hydra's files, since Hydra would follow it."""
    check_job_links(runs, runs / FOLDER)
