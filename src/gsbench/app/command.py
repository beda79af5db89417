"""gsbench as a Hydra app: a command line becomes trials and an exit code.

Before Hydra runs, the whole configuration is composed and checked (`gsbench.config.compose`). Then ``hydra.main`` runs
the task once, or hands it to gsbench's sweeper. A sweep may first tune its arms (`gsbench.app.tuning`). Its trials run
as one batch, or seed by seed until their question is decided.
"""

import logging
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn
from hydra.errors import HydraException
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, RunMode, TaskFunction
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gsbench.analysis.quantities import COSTS
from gsbench.app.tuning import tuned_jobs
from gsbench.claims.stopping import KeyAndSeed, headline, plan_sweep, run_looks
from gsbench.config import compose
from gsbench.config.command_words import (
    bare_key,
    check_removal,
    check_words,
    grid_points,
    is_interval,
    is_sweep,
    key_of,
    parse,
    parse_word,
    value_text,
)
from gsbench.config.compose import Trial
from gsbench.config.trust import PERMISSIONS, check_composed, load_callbacks
from gsbench.errors import GsbenchError, InputError
from gsbench.eval.options import EvalConfig
from gsbench.files import checked_runs_folder, make_runs_folder
from gsbench.launch.batch import begin_for_another_launcher, check_parts, missing_folders, need_no_check, run_batch
from gsbench.launch.jobs import Outcome, outcome_of_error
from gsbench.launch.record import declare_questions
from gsbench.launch.states import describe_plan
from gsbench.logs import set_up_logging
from gsbench.runs.layout import RESULTS
from gsbench.system.own_modules import allow_modules

GRIDS = "hydra.sweeper.grids"
OWN_LAUNCHER = "gsbench"  # its name in Hydra

log = logging.getLogger(__name__)


def launch(argv: list[str]) -> int:
    """Run the trials of the command line ``argv``; returns 0 if all are done (or left to Slurm), 1 if some failed.

    Raises InputError for a wrong configuration, and for a single trial's bad input.
    """
    words, multirun, dry_run = parse(argv)
    task = TrialTask(list_trials, look_only=True) if dry_run else TrialTask(run_batch)
    run_app(words, multirun, task)
    if dry_run or not task.trials:  # a sweep whose question is decided needs no trial
        return 0
    return summarize(task.outcomes, task.trials)


def compose_trials(words: Sequence[str], multirun: bool = False) -> list[Trial]:
    """The trials that a command line would run."""
    task = TrialTask(lambda trials: [], look_only=True)
    run_app(words, multirun, task)
    return task.trials


def one_trial_per_scene(verb: str, settings: Sequence[str], metric: str) -> dict[str, Trial]:
    """A trial of each scene, for a verb that compares two versions of one trainer (gate, bisect).

    Raises InputError for settings that make more than one arm, and for a metric that the trials do not compute.
    """
    keys = [word.partition("=")[0].lstrip("+") for word in settings]
    if implied := [key for key in keys if key in ("seed", "eval.primary")]:
        raise InputError(f"{verb}: {implied[0]} follows from the other words: leave it out")
    trials = compose_trials([*settings, "seed=0", *([] if "name" in keys else [f"name={verb}"])], multirun=True)
    by_scene = {trial.values["scene"]["name"]: trial for trial in trials}
    if len(by_scene) < len(trials):
        raise InputError(f"{verb} is about one arm: only scene may list values")
    if not trials[0].values["launch"]["wait"]:
        raise InputError(f"{verb} needs results to go on: leave launch.wait=false out")
    if metric not in COSTS:
        EvalConfig(**trials[0].values["eval"] | {"primary": metric})
    return by_scene


def run_trials(trials: Sequence[Trial]) -> int:
    """Run those ``trials`` that are not done, by the launcher that they name; returns the exit code."""
    return summarize(run_batch(trials), trials)


@dataclass
class TrialTask:
    """Hydra's task function: it gets a composed configuration and hands its trial to ``handle``.

    ``handle`` runs trials; with ``look_only`` it only reports what would run. ``allowed`` is what the command line
    permits, ``folder`` holds the user's modules, ``grids`` are the grids that gsbench's sweeper joins. ``trials`` and
    ``outcomes`` collect all batches of a sweep.
    """

    handle: Callable[[Sequence[Trial]], list[Outcome]]
    look_only: bool = False
    allowed: tuple[str, ...] = ()
    folder: str = field(default_factory=os.getcwd)
    grids: Any = None
    trials: list[Trial] = field(default_factory=list)
    outcomes: list[Outcome] = field(default_factory=list)

    def __reduce__(self) -> tuple[Any, ...]:
        # Pickled for another launcher's processes, which need nothing that was collected here.
        return TrialTask, (self.handle, self.look_only, self.allowed, self.folder)

    def __call__(self, config: DictConfig) -> None:
        """Run one trial. Called by Hydra or by another launcher, perhaps in another process; raises if it failed."""
        allow_modules(self.allowed, self.folder)
        set_up_logging()
        hydra: Any = HydraConfig.instance().cfg
        # Checked again: the files that this job chooses may set other things of Hydra than the checked ones.
        check_composed(hydra, self.allowed)
        hydra_words, words = compose.typed_words(hydra.hydra.overrides)
        trial = compose.resolve_trial(compose.enforce_permissions(config, self.allowed), [*hydra_words, *words])
        if hydra.hydra.mode == RunMode.RUN:
            self.launch([trial])
            return
        # A job of a sweep: its launcher passes on what is raised.
        (outcome,) = self.handle([trial])
        if outcome.status == "failed":
            raise (InputError if outcome.bad_input else GsbenchError)(outcome.message)

    def launch(self, trials: Sequence[Trial]) -> None:
        """Run a batch of trials."""
        self.trials += trials
        self.outcomes += self.handle(trials)


def run_app(words: Sequence[str], multirun: bool, task: TrialTask) -> None:
    """Run ``task`` for the trials of a command line: one, or many with ``multirun`` or an experiment that is a sweep.

    Raises InputError, one line, for a wrong configuration.
    """
    check_words(words)
    swept = [word for word in words if is_sweep(word)]
    with compose.hydra_ready():
        config = compose.compose_whole([*words, "hydra.mode=MULTIRUN"] if multirun else words)
    multirun = config.hydra.mode == RunMode.MULTIRUN
    if swept and not multirun:
        raise InputError(f"{swept[0]} lists several values: add -m to run one trial for each")
    with compose.explained(words):
        check_sweep_settings(config, multirun)
    task.allowed = tuple(config[PERMISSIONS])
    task.grids = OmegaConf.to_container(config.hydra.sweeper, resolve=False).get("grids")  # type: ignore[union-attr]
    # The grids are taken out: Hydra would resolve their ${…} when it makes the sweeper, before each trial's values.
    argv = [*words, *[f"{GRIDS}=[]"] * bool(task.grids)]
    if task.look_only:  # nothing runs, so no callback is called
        argv += [f"~hydra.callbacks.{name}" for name in config.hydra.callbacks]
    else:
        load_callbacks(config.hydra.callbacks, task.allowed)
    with compose.explained(words, (HydraException, OmegaConfBaseException, OSError)):
        compose.run_main(task, [*argv, f"hydra.mode={'MULTIRUN' if multirun else 'RUN'}"], task.allowed)


def list_trials(trials: Sequence[Trial]) -> list[Outcome]:
    """Print the trials with their states, and the folders that they will miss; run none."""
    if not need_no_check(trials):
        check_parts(trials, on_this_machine=False)
    lines = describe_plan(trials, trials[0].values["launch"]["parallel"])
    print("\n".join([*lines, *missing_folders(trials)]))
    return []


def check_sweep_settings(config: DictConfig, multirun: bool) -> None:
    """Refuse settings of a sweep without a sweep, parameters that are no mapping, and a second launcher."""
    sweeper = config.hydra.sweeper
    params = sweeper.get("params")
    if not multirun and config.hydra.mode is None and (params or sweeper.get("grids")):
        raise InputError("hydra.sweeper lists values: add -m to run a trial for each, or hydra.mode=RUN for one")
    if params is not None and not OmegaConf.is_dict(params):
        raise InputError(f"hydra.sweeper.params={params} must map settings to values; seed=0,1 can be typed itself")
    if config.launch.stop_when_decided and not multirun:
        raise InputError("launch.stop_when_decided adds seeds to a sweep: add -m, two densifiers and seed=0,1,2,3")
    launcher = config.hydra.runtime.choices["hydra/launcher"]
    if launcher != OWN_LAUNCHER and not multirun:
        raise InputError(f"hydra/launcher={launcher} launches sweeps: add -m, or leave it out")
    if launcher != OWN_LAUNCHER and config.launch.name != "serial":
        raise InputError(f"hydra/launcher={launcher} and launch={config.launch.name} are two launchers: choose one")


def summarize(outcomes: Sequence[Outcome], trials: Sequence[Trial]) -> int:
    """Report how the trials ended; returns 0 if all are done, 1 if some failed, 2 if all failed for bad input.

    A single trial's failure is raised, so that the program prints this one line only.
    """
    failed = [outcome for outcome in outcomes if outcome.status == "failed"]
    if failed and len(outcomes) == 1:
        raise (InputError if failed[0].bad_input else GsbenchError)(failed[0].message)
    for outcome in failed:
        print(f"gsbench: failed: {outcome.label}: {outcome.message}", file=sys.stderr)
    name = trials[-1].values["name"]  # the last one's: a tuning runs before, in its own experiments
    done = sum(outcome.status == "done" for outcome in outcomes)
    if any(outcome.status == "queued" for outcome in outcomes):
        advice = f"how far the others are: gsbench status {name}"
    else:
        advice = f"again: gsbench retry {name}" if failed else f"the table: gsbench tables {name}"
        if len(outcomes) == 1:
            advice += f"; renders and model: {outcomes[0].folder}"
    log.info("%d of %d trials done; %s", done, len(outcomes), advice)
    if failed and all(outcome.status == "failed" and outcome.bad_input for outcome in outcomes):
        return 2
    return 1 if failed else 0


# ---- sweeps


@dataclass(frozen=True)
class Sweep:
    """A sweep that Hydra has started: its configuration, its task, Hydra's context and the launcher."""

    config: DictConfig
    task: TrialTask
    context: HydraContext
    launcher: Launcher

    @classmethod
    def begin(cls, context: HydraContext, task: TaskFunction, config: DictConfig) -> Self:
        """Make a sweep from what Hydra gives a sweeper."""
        assert isinstance(task, TrialTask)
        config.allow_targets = list(task.allowed)
        compose.resolve_times(config)
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
        for word in words:  # those from a file were not checked before
            if (override := parse_word(word)).is_delete():
                check_removal(override)
        with compose.explained(words):
            return OverridesParser.create(self.context.config_loader).parse_overrides(list(words))

    def trials(self, jobs: Sequence[Sequence[str]]) -> list[Trial]:
        """The trials of ``jobs``, each the list of its words."""
        return compose.compose_jobs(self.context.config_loader, self.config, jobs)

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


# ---- grids
#
# An experiment's file may join several grids. Each maps settings to values, and all share the settings of
# ``hydra.sweeper.params``:
#
#     hydra:
#       mode: MULTIRUN
#       sweeper:
#         params:
#           seed: 0,1,2
#         grids:
#           - densify: adc
#           - densify: volumetric
#             densify.volume_threshold: 0.01,0.03
#
# If some grids list the setting of a word of the command line, the word replaces their values and does not reach the
# other grids. Any other word is for all grids.


def checked_grids(grids: Any) -> list[dict[str, str]]:
    """The grids of the configuration, with values as texts. Raises InputError unless they are a list of mappings."""
    if not isinstance(grids, list) or not all(isinstance(grid, dict) and grid for grid in grids):
        raise InputError(f"{GRIDS} must be a list, each a mapping of settings to values, got {grids!r}")
    return [{str(key): _text(key, value) for key, value in grid.items()} for grid in grids]


def words_of_grids(
    params: Mapping[str, Any], grids: Sequence[Mapping[str, str]], given: Sequence[str]
) -> list[list[str]]:
    """The words of each grid: its own, the shared ``params``, and the words ``given`` that are for it.

    If two set one key, the later counts. Trials are in the order of the grids; the shared settings vary fastest.
    """
    listed = {bare_key(key) for grid in grids for key in grid}
    return [
        [
            *(f"{key}={value}" for key, value in grid.items()),
            *(f"{key}={value}" for key, value in params.items() if bare_key(key) not in map(bare_key, grid)),
            *(word for word in given if key_of(word) not in listed - set(map(bare_key, grid))),
        ]
        for grid in grids or [{}]
    ]


def _text(key: object, value: object) -> str:
    if value is None or isinstance(value, list | dict):
        raise InputError(f"{GRIDS}: {key} must list values as on the command line, such as 1,2,3, got {value!r}")
    return value_text(value)
