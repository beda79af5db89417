"""A sweep: its trials, run as one batch, or seed by seed until their question is decided.

A sweep may first tune its arms (`gsbench.app.tuning`).
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig

from gsbench.app.command import OWN_LAUNCHER, TrialTask
from gsbench.app.grids import bare_key, checked_grids, grid_points, is_interval, words_of_grids
from gsbench.app.tuning import tuned_jobs
from gsbench.claims.stopping import KeyAndSeed, headline, plan_sweep, run_looks
from gsbench.config.command_words import parse_word
from gsbench.config.compose import Trial, compose_jobs, resolve_times
from gsbench.config.hydra_entry import explained
from gsbench.errors import GsbenchError
from gsbench.files import checked_runs_folder, make_runs_folder
from gsbench.launch.batch import begin_for_another_launcher
from gsbench.launch.jobs import Outcome, outcome_of_error
from gsbench.launch.record import declare_questions
from gsbench.runs.layout import RESULTS

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Sweep:
    """A sweep that Hydra has started: its configuration, its task, Hydra's context and the launcher."""

    config: DictConfig
    task: TrialTask
    context: HydraContext
    launcher: Launcher

    @classmethod
    def begin(cls, context: HydraContext, task: TaskFunction, config: DictConfig) -> Sweep:
        """Make a sweep from what Hydra gives a sweeper."""
        assert isinstance(task, TrialTask)
        config.allow_targets = list(task.allowed)
        resolve_times(config)
        launcher = Plugins.instance().instantiate_launcher(hydra_context=context, task_function=task, config=config)
        return cls(config, task, context, launcher)

    def run(self, params: Mapping[str, Any], tune: Mapping[str, Any], words: Sequence[str]) -> None:
        """Run all points that the ``words`` and ``params`` (``hydra.sweeper.params``) of the sweep span.

        ``tune`` (``hydra.sweeper.tune``) says how intervals among them are searched first (`gsbench.app.tuning`).
        """
        grids = checked_grids(self.task.grids or [])
        jobs: list[list[str]] = []
        intervals: list[dict[str, Override]] = []  # for each job, the settings that are searched for its arm
        for grid_words in words_of_grids(params, grids, words):
            by_key = {bare_key(override.get_key_element()): override for override in self.parse(grid_words)}
            points = grid_points([override for override in by_key.values() if not is_interval(override)])
            jobs += points
            searched = {override.get_key_element(): override for override in by_key.values() if is_interval(override)}
            intervals += [searched] * len(points)
        trials = self.trials(tuned_jobs(self, tune, jobs, intervals))
        if any(trial.values["launch"]["stop_when_decided"] for trial in trials):
            self._run_until_decided(trials)
        else:
            self.launch(trials)

    def parse(self, words: Sequence[str]) -> list[Override]:
        """The words as Hydra reads them, with the choices of ``glob(*)``."""
        for word in words:
            parse_word(word)  # for its errors: words from a file were not checked before
        with explained(words):
            return OverridesParser.create(self.context.config_loader).parse_overrides(list(words))

    def trials(self, jobs: Sequence[Sequence[str]]) -> list[Trial]:
        """The trials of ``jobs``, each the list of its words."""
        return compose_jobs(self.context.config_loader, self.config, jobs)

    def launch(self, trials: Sequence[Trial]) -> None:
        """Run trials by the launcher. For another launcher than gsbench's, all trials are checked before the first."""
        name = self.config.hydra.runtime.choices["hydra/launcher"]
        if name == OWN_LAUNCHER or self.task.look_only:
            self.task.launch(trials)
            return
        begin_for_another_launcher(trials)
        jobs = [[word for word in trial.overrides if not parse_word(word).is_hydra_override()] for trial in trials]
        try:
            returned = self.launcher.launch(jobs, initial_job_idx=len(self.task.trials))
        except GsbenchError:
            raise
        except Exception as error:
            message = " ".join(str(error).split()) or type(error).__name__
            raise GsbenchError(f"hydra/launcher={name}: {message} (gsbench status tells how far it came)") from error
        self.task.trials += trials
        self.task.outcomes += [_outcome(trial, ended) for trial, ended in zip(trials, returned, strict=True)]

    def _run_until_decided(self, trials: Sequence[Trial]) -> None:
        """Run the trials in the looks that the sequential test plans. Decided pairs of arms get no further trials.

        Raises InputError for a sweep that cannot be tested so.
        """
        stopping = plan_sweep(trials)
        if self.task.look_only:
            print(stopping.describe())
            self.launch(trials)
            return
        make_runs_folder(checked_runs_folder(trials[0].values["runs"]))
        stopping = replace(stopping, declaration=declare_questions(stopping.home, stopping.declaration))
        launched: set[Path] = set()

        def run(planned: Sequence[KeyAndSeed]) -> None:
            batch = [trial for key in planned if (trial := stopping.trials[key]).folder not in launched]
            launched.update(trial.folder for trial in batch)
            if batch:
                self.launch(batch)

        for verdict in run_looks(stopping.declaration, stopping.judged, run):
            log.info("%s", headline(verdict))
        spared = [trial for trial in trials if trial.folder not in launched and not (trial.folder / RESULTS).exists()]
        log.info("%d of %d trials were not needed", len(spared), len(trials))


def _outcome(trial: Trial, returned: JobReturn) -> Outcome:
    """The outcome of a trial that another launcher ran."""
    value: Any = returned._return_value  # the public property `return_value` would write a line to stderr
    return outcome_of_error(trial.folder, value) if isinstance(value, Exception) else Outcome(trial.folder, "done")
