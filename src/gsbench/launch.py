"""Trials through Hydra: compose, check, run one or a sweep, and turn Hydra's errors into one line."""

from __future__ import annotations

import logging
import os
import re
import sys
from pathlib import Path
from typing import Any

import hydra
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gsbench.config import check, closest, conf_dir, plain, register_schemas
from gsbench.errors import GsbenchError, InputError

log = logging.getLogger(__name__)

GROUPS = ("scene", "init", "densify", "raster", "train", "eval", "tracking", "launch", "experiment")


def launch(argv: list[str]) -> int:
    """Run the trials of the Hydra command line ``argv``; 0 if all are done, 1 if some failed.

    Raises InputError for a configuration that does not compose or hold together, and for a single trial's bad input.
    """
    register_schemas()
    sys.path.insert(0, os.getcwd())  # a user's own class lies beside the user
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises instead of printing and exiting
    outcomes: list[Outcome] = []

    def task(config: DictConfig) -> None:
        check(config)
        values = plain(config)
        try:
            outcomes.append(Outcome(values, None, _run(values, config)))
        except GsbenchError as error:
            outcomes.append(Outcome(values, error, None))
        except Exception as error:
            log.debug("unexpected error", exc_info=True)
            outcomes.append(Outcome(values, error, None))

    saved = sys.argv
    sys.argv = ["gsbench", *argv]
    try:
        hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name="config")(task)()
    except (HydraException, OmegaConfBaseException) as error:
        raise InputError(explain(error, argv)) from error
    finally:
        sys.argv = saved
    return _summarize(outcomes)


class Outcome:
    """How a trial ended: with results, or with an error."""

    def __init__(self, values: dict[str, Any], error: Exception | None, results: dict[str, Any] | None) -> None:
        self.values, self.error, self.results = values, error, results


def _run(values: dict[str, Any], config: DictConfig) -> dict[str, Any]:
    from gsbench.pipeline.trial import run_trial

    return run_trial(values, OmegaConf.to_yaml(config, resolve=True))


def _summarize(outcomes: list[Outcome]) -> int:
    failed = [outcome for outcome in outcomes if outcome.error is not None]
    if len(outcomes) == 1 and failed:
        error = failed[0].error
        assert error is not None
        if isinstance(error, GsbenchError):
            raise error
        raise GsbenchError(f"{type(error).__name__}: {error}; the traceback is in the trial's log.txt") from error
    for outcome in failed:
        values = outcome.values
        arm = f"{values['scene']['name']}/{values['init']['name']}-{values['densify']['name']} seed {values['seed']}"
        print(f"gsbench: failed: {arm}: {outcome.error}", file=sys.stderr)
    if outcomes:
        name = outcomes[0].values["name"]
        log.info("%d of %d trials done; the table: gsbench tables %s", len(outcomes) - len(failed), len(outcomes), name)
    if failed and all(isinstance(outcome.error, InputError) for outcome in outcomes):
        return 2
    return 1 if failed else 0


def explain(error: Exception, argv: list[str]) -> str:
    """Hydra's error in one line that names the key, what is allowed, and the nearest choice."""
    text = " ".join(_chain(error))
    override = re.search(r"Could not override '([^']+)'", text)
    unknown = re.search(r"Key '([^']+)' (?:is not in struct|not in '[^']+')", text)
    if unknown and override:
        key, bad = override.group(1), unknown.group(1)
        parent = key[: key.rindex(bad)].rstrip(".") if bad in key else key.rpartition(".")[0]
        known = _keys_below(parent, argv)
        return f"{key} is not a setting{closest(bad, known)} ({parent or 'top level'} has: {', '.join(known)})"
    missing = re.search(r"Could not find '([^']+)'.*?Available options in '([^']+)':\s*(.*?)(?:\n\n|Config search|$)", text, re.S)
    if missing:
        wanted, group = missing.group(1), missing.group(2)
        options = _options(group)
        word = wanted.rpartition("/")[2]
        return f"{group}={word} does not exist{closest(word, options)} (choose: {', '.join(options)})"
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return " ".join(lines)[:500]


def _chain(error: BaseException | None) -> list[str]:
    messages = []
    while error is not None:
        messages.append(str(error))
        error = error.__cause__
    return messages


def _keys_below(parent: str, argv: list[str]) -> list[str]:
    """The settings below ``parent`` with the group choices of ``argv``, as far as these compose."""
    choices = [word for word in argv if re.fullmatch(r"\w+=[\w-]+", word) and word.split("=")[0] in GROUPS]
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        try:
            config = compose("config", overrides=choices)
        except (HydraException, OmegaConfBaseException):
            config = compose("config")
    node = OmegaConf.select(config, parent) if parent else config
    return [str(key) for key in node] if isinstance(node, DictConfig) else []


def _options(group: str) -> list[str]:
    return sorted(path.stem for path in Path(conf_dir(), group).glob("*.yaml"))


def options_text() -> str:
    """The choices of every group."""
    lines = ["Groups:"]
    for group in GROUPS:
        prefix = "+experiment" if group == "experiment" else group
        lines.append(f"  {prefix + '=':<13}{', '.join(_options(group))}")
    return "\n".join(lines)
