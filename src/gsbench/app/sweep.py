"""A sweep: the trials that its words make, run all at once or seed by seed until their question is decided.

Either may begin by tuning its arms (`gsbench.app.tuning`).
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

from gsbench.app.command import OWN, Task
from gsbench.app.grids import bare, checked_grids, grid, is_interval, words_of_grids
from gsbench.app.tuning import tuned_jobs
from gsbench.claims.stopping import Planned, headline, plan_sweep, run_looks
from gsbench.config.command_words import parse_word
from gsbench.config.compose import Trial, compose_jobs, resolve_times
from gsbench.config.hydra_entry import explained
from gsbench.errors import GsbenchError
from gsbench.files import checked_runs_folder, make_runs_folder
from gsbench.launch.batch import begin_for_another_launcher
from gsbench.launch.record import declare_questions
from gsbench.launch.serial import Outcome, outcome_of_error
from gsbench.runs.layout import RESULTS

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Sweep:
    """A sweep that Hydra has begun: its configuration, its task, and what makes jobs of words and runs them."""

    config: DictConfig
    task: Task
    context: HydraContext
    launcher: Launcher

    @classmethod
    def begin(cls, context: HydraContext, task: TaskFunction, config: DictConfig) -> Sweep:
        """The work of gsbench's sweeper on what Hydra gives it."""
        assert isinstance(task, Task)
        config.allow_targets = list(task.allowed)
        resolve_times(config)
        launcher = Plugins.instance().instantiate_launcher(hydra_context=context, task_function=task, config=config)
        return cls(config, task, context, launcher)

    def run(self, params: Mapping[str, Any], tune: Mapping[str, Any], words: Sequence[str]) -> None:
        """Run all points that the words of the sweep span; ``params`` are the settings and values of
        ``hydra.sweeper.params``, ``tune`` says how the intervals among them are searched before (`gsbench.app.tuning`).
        """
        grids = checked_grids(self.task.grids or [])
        jobs: list[list[str]] = []
        intervals: list[dict[str, Override]] = []  # among the words of each job: what is searched for its arm
        for of_grid in words_of_grids(params, grids, words):
            given = {bare(one.get_key_element()): one for one in self.parse(of_grid)}  # the later counts
            points = grid([one for one in given.values() if not is_interval(one)])
            jobs += points
            searched = {one.get_key_element(): one for one in given.values() if is_interval(one)}
            intervals += [searched] * len(points)
        trials = self.trials(tuned_jobs(self, tune, jobs, intervals))
        if any(trial.values["launch"]["stop_when_decided"] for trial in trials):
            self._run_until_decided(trials)
        else:
            self.launch(trials)

    def parse(self, words: Sequence[str]) -> list[Override]:
        """The words as Hydra reads them, with the choices of ``glob(*)``."""
        for word in words:
            parse_word(word)  # which says what is wrong with one that a file has
        with explained(words):
            return OverridesParser.create(self.context.config_loader).parse_overrides(list(words))

    def trials(self, jobs: Sequence[Sequence[str]]) -> list[Trial]:
        """The trials of jobs, each the list of its words."""
        return compose_jobs(self.context.config_loader, self.config, jobs)

    def launch(self, trials: Sequence[Trial]) -> None:
        """Run trials by the launcher.

        Another launcher than gsbench's gets them after a look at all, so that what is refused is refused before work.
        """
        name = self.config.hydra.runtime.choices["hydra/launcher"]
        if name == OWN or self.task.look_only:
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
        """Run the trials in planned looks, and no further ones of pairs of arms that are decided.

        Raises InputError for a sweep that cannot be looked at so.
        """
        stopping = plan_sweep(trials)
        if self.task.look_only:
            print(stopping.describe())
            self.launch(trials)
            return
        make_runs_folder(checked_runs_folder(trials[0].values["runs"]))
        stopping = replace(stopping, declaration=declare_questions(stopping.home, stopping.declaration))
        launched: set[Path] = set()

        def run(planned: Sequence[Planned]) -> None:
            batch = [trial for key in planned if (trial := stopping.trials[key]).folder not in launched]
            launched.update(trial.folder for trial in batch)
            if batch:
                self.launch(batch)

        for verdict in run_looks(stopping.declaration, stopping.judged, run):
            log.info("%s", headline(verdict))
        spared = [trial for trial in trials if trial.folder not in launched and not (trial.folder / RESULTS).exists()]
        log.info("%d of %d trials were not needed", len(spared), len(trials))


def _outcome(trial: Trial, returned: JobReturn) -> Outcome:
    """Say how a trial ended that another launcher ran."""
    value: Any = returned._return_value  # the property of that name would write a line to stderr
    return outcome_of_error(trial.folder, value) if isinstance(value, Exception) else Outcome(trial.folder, "done")
