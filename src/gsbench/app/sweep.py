"""A command line that was read: its words, its configuration, and how its trials ended."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gsbench.config.build import facts_for
from gsbench.config.command_words import check_removal, check_words
from gsbench.config.compose import Composer, Trial, config_loader, hydra_config, hydra_ready
from gsbench.config.explain import explained
from gsbench.config.overrides import is_sweep, parse_word
from gsbench.errors import InputError
from gsbench.logs import set_up_logging
from gsbench.runs.experiments import DEFAULT_METRIC, metric_and_question

if TYPE_CHECKING:  # loads scipy, which completion does without
    from gsbench.launch.jobs import Outcome

OWN = "gsbench"  # the name of the launcher and of the sweeper in Hydra
BASIC = "basic"  # Hydra's own sweeper, which expands lists, and its launcher
# the errors of Hydra for a user's words and files
HYDRA_ERRORS = (HydraException, OmegaConfBaseException, OSError)

Run = Callable[[Sequence[Trial]], object]  # runs trials to their ends


@dataclass
class Ended:
    """The trials that a command ran, and their outcomes."""

    trials: list[Trial] = field(default_factory=list)
    outcomes: list[Outcome] = field(default_factory=list)

    def add(self, trials: Sequence[Trial], outcomes: Sequence[Outcome]) -> None:
        self.trials += trials
        self.outcomes += outcomes


class Sweep(Composer):
    """A command for a single trial or, with ``multirun``, for many: it composes their trials.

    Logging is set up as the ``words`` say. Raises InputError with one line for wrong ones.
    """

    def __init__(
        self, words: Sequence[str], multirun: bool, typed: Sequence[str] | None = None
    ) -> None:
        check_words(words)
        super().__init__(words, typed)
        config = self.config
        # without -m, a file may say that it is a sweep
        multirun = multirun or config.hydra.mode == RunMode.MULTIRUN
        swept = [word for word in words if is_sweep(word)]
        if swept and not multirun:
            raise InputError(f"{swept[0]} lists several values: add -m to run one trial for each")
        with explained(words):
            check_sweep_settings(config, multirun)
            config.hydra.mode = RunMode.MULTIRUN if multirun else RunMode.RUN
            if not multirun:  # a reference to nothing is refused before any work
                with hydra_config(config):
                    os.path.abspath(config.hydra.run.dir)
        set_up_logging(config.hydra.verbose)
        self.words, self.multirun = tuple(words), multirun

    @property
    def other_sweeper(self) -> str:
        """The name of the chosen sweeper; empty if it is gsbench's, or none is needed."""
        name = str(self.config.hydra.runtime.choices["hydra/sweeper"])
        return name if self.multirun and name != OWN else ""

    def parse(self, words: Sequence[str]) -> list[Override]:
        """The words as Hydra reads them, with the choices of ``glob(*)``."""
        for word in words:  # those from a file were not checked before
            if (override := parse_word(word)).is_delete():
                check_removal(override)
        with hydra_ready(), explained(words):
            return OverridesParser.create(config_loader()).parse_overrides(list(words))


def searched_metric(values: Mapping[str, Any]) -> tuple[str, Literal[-1, 1]]:
    """The metric of ``eval.primary`` (default: PSNR), and 1 if more of it is better, else -1.

    Raises InputError if that is not known.
    """
    metric, _ = metric_and_question(str(values["eval"].get("primary") or DEFAULT_METRIC))
    direction = facts_for(metric, values).direction
    if not direction:
        raise InputError(
            f"eval.primary={metric}: whether more or less of it is better is not known"
        )
    return metric, 1 if direction > 0 else -1


def check_sweep_settings(config: DictConfig, multirun: bool) -> None:
    """Refuse a sweep's settings without a sweep, params that are no mapping, and two launchers."""
    sweeper = config.hydra.sweeper
    params = sweeper.get("params")
    if not multirun and config.hydra.mode is None and (params or sweeper.get("grids")):
        raise InputError(
            "hydra.sweeper lists values: add -m to run a trial for each, or hydra.mode=RUN for one"
        )
    if params is not None and not OmegaConf.is_dict(params):
        raise InputError(
            f"hydra.sweeper.params={params} must map settings to values; seed=0,1 can be typed "
            "itself"
        )
    if config.launch.stop_when_decided and not multirun:
        raise InputError(
            "launch.stop_when_decided adds seeds to a sweep: add -m, two densifiers and "
            "seed=0,1,2,3"
        )
    launcher = config.hydra.runtime.choices["hydra/launcher"]
    if launcher != OWN and not multirun:
        raise InputError(f"hydra/launcher={launcher} launches sweeps: add -m, or leave it out")
    if launcher != OWN and config.launch.name != "serial":
        raise InputError(
            f"hydra/launcher={launcher} and launch={config.launch.name} are two launchers: choose "
            "one"
        )
