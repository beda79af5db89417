"""A sweep: the words of its jobs, the trials that they make, and the launcher that runs these.

An experiment's file may join several grids, below ``hydra.sweeper.grids``. Each names settings and their values as
``hydra.sweeper.params`` does, which they share:

    hydra:
      mode: MULTIRUN
      sweeper:
        params:
          seed: 0,1,2
        grids:
          - densify: adc
          - densify: volumetric
            densify.volume_threshold: 0.01,0.03

A word of the command line whose setting some of the grids list is meant for these, and takes the place of what they
list; any other word is meant for all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig

from gsbench.app.command import OWN, Task
from gsbench.config.command_words import check_sweep, parse_word
from gsbench.config.jobs import JobContext, begin_sweep, compose_jobs
from gsbench.config.messages import explained
from gsbench.errors import GsbenchError, InputError
from gsbench.launch.batch import begin_for_another_launcher
from gsbench.launch.outcome import Outcome, outcome_of_error
from gsbench.launch.trial import Trial

GRIDS = "hydra.sweeper.grids"


@dataclass(frozen=True)
class Sweep:
    """A sweep that Hydra has begun: its configuration, its task, and what makes jobs of words and runs them."""

    config: DictConfig
    task: Task
    context: HydraContext
    launcher: Launcher

    @classmethod
    def begin(cls, context: HydraContext, task: TaskFunction, config: DictConfig) -> Sweep:
        """The work of gsbench's sweepers on what Hydra gives them."""
        assert isinstance(task, Task)
        context = JobContext(context.config_loader, context.callbacks)
        begin_sweep(config, record=not task.look_only)
        launcher = Plugins.instance().instantiate_launcher(hydra_context=context, task_function=task, config=config)
        return cls(config, task, context, launcher)

    def parse(self, words: Sequence[str]) -> list[Override]:
        """The words as Hydra reads them, with the choices of ``glob(*)``."""
        with explained(words):
            return OverridesParser.create(self.context.config_loader).parse_overrides(list(words))

    def trials(self, jobs: Sequence[Sequence[str]], first: int = 0) -> list[Trial]:
        """The trials of jobs, each the list of its words, whose numbers begin at ``first``."""
        return trials_of_jobs(self.task, self.context, self.config, jobs, first)

    def launch(self, trials: Sequence[Trial], first: int | None = None) -> Sequence[JobReturn]:
        """Run trials by the launcher.

        ``first`` is the number of the first job, by which Hydra's launchers name folders; by default the trial's own.
        Another launcher than gsbench's gets them after a look at all, so that what is refused is refused before work.
        """
        name = self.config.hydra.runtime.choices["hydra/launcher"]
        if name == OWN or self.task.look_only:
            return self.task.launch(trials)
        begin_for_another_launcher(trials)
        jobs = [trial.job for trial in trials if trial.job is not None]
        try:
            returned = self.launcher.launch(
                [list(job.words) for job in jobs], initial_job_idx=jobs[0].number if first is None else first
            )
        except GsbenchError:
            raise
        except Exception as error:
            message = " ".join(str(error).split()) or type(error).__name__
            raise GsbenchError(f"hydra/launcher={name}: {message} (gsbench status tells how far it came)") from error
        self.task.trials += trials
        self.task.outcomes += [_outcome(trial, ended) for trial, ended in zip(trials, returned, strict=True)]
        return returned


def trials_of_jobs(
    task: TaskFunction, context: HydraContext, config: DictConfig, jobs: Sequence[Sequence[str]], first: int
) -> list[Trial]:
    """The trials of a sweep's jobs, with what the command line permits."""
    assert isinstance(task, Task)
    config.allow_targets = list(task.allowed)
    return [Trial.of(composed) for composed in compose_jobs(context, config, jobs, first)]


def _outcome(trial: Trial, returned: JobReturn) -> Outcome:
    """Say how a trial ended that another launcher ran."""
    value: Any = returned._return_value  # the property of that name would write a line to stderr
    return outcome_of_error(trial.folder, value) if isinstance(value, Exception) else Outcome(trial.folder, "done")


# ---- grids


def grid(overrides: Sequence[Override]) -> list[list[str]]:
    """The words of every point of the grid that ``overrides`` span; of two for one key the later counts."""
    choices: dict[str, list[str]] = {}
    for override in overrides:
        key = override.get_key_element()
        if override.is_sweep_override():
            check_sweep(override)
            try:
                choices[key] = [f"{key}={value}" for value in override.sweep_string_iterator()]
            except ValueError as error:  # such as a range of steps of 0
                raise InputError(f"{override.input_line}: {error}") from error
            if not choices[key]:
                raise InputError(f"{override.input_line} lists no value")
        else:
            choices[key] = [key if override.is_delete() else f"{key}={override.get_value_element_as_str()}"]
    return [list(point) for point in product(*choices.values())]


def is_interval(override: Override) -> bool:
    """Return whether a word gives an interval, in which a value is searched, in place of a list of values."""
    return override.is_sweep_override() and not override.is_discrete_sweep()


def intervals_of(overrides: Sequence[Override]) -> dict[str, str]:
    """The intervals among words: the text of each by its setting."""
    return {one.get_key_element(): str(one.input_line).partition("=")[2] for one in overrides if is_interval(one)}


def checked_grids(grids: Any) -> list[dict[str, str]]:
    """The grids as they stand in the configuration; raises InputError for what is no list of settings with values."""
    if not isinstance(grids, list) or not all(isinstance(grid, dict) and grid for grid in grids):
        raise InputError(f"{GRIDS} must be a list, each a mapping of settings to values, got {grids!r}")
    return [{str(key): _text(key, value) for key, value in grid.items()} for grid in grids]


def words_of_grids(
    params: Mapping[str, Any], grids: Sequence[Mapping[str, str]], given: Sequence[str]
) -> list[list[str]]:
    """List the words of each grid: its own, the shared ones, and of the command line those that are meant for it.

    Of two for one setting the later counts; trials are in the order of the grids, the shared settings varying fastest.
    """
    listed = {_bare(key) for grid in grids for key in grid}
    return [
        [
            *(f"{key}={value}" for key, value in grid.items()),
            *(f"{key}={value}" for key, value in params.items() if _bare(key) not in map(_bare, grid)),
            *_meant_for(grid, given, listed),
        ]
        for grid in grids or [{}]
    ]


def _meant_for(grid: Mapping[str, str], given: Sequence[str], listed: set[str]) -> list[str]:
    own = {_bare(key) for key in grid}
    keys = [_bare(parse_word(word).get_key_element()) for word in given]
    return [word for word, key in zip(given, keys, strict=True) if key in own or key not in listed]


def _bare(key: str) -> str:
    return key.lstrip("+~")


def _text(key: object, value: object) -> str:
    if value is None or isinstance(value, list | dict):
        raise InputError(f"{GRIDS}: {key} must list values as on the command line, such as 1,2,3, got {value!r}")
    return str(value).lower() if isinstance(value, bool) else str(value)
