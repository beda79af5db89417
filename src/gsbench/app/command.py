"""gsbench as a Hydra app: a command line becomes trials and an exit code.

Before Hydra runs, the whole configuration is composed and checked (`gsbench.config.compose`). Then
``hydra.main`` runs the task once, or hands it to a sweeper: gsbench's (`gsbench.app.grids`) or
another (`gsbench.app.other_sweepers`).
"""

import logging
import os
import sys
from collections.abc import Sequence
from typing import Any

from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gsbench.analysis.quantities import COSTS
from gsbench.app.grids import GRIDS, run_sweep
from gsbench.app.other_sweepers import (
    GRID_SWEEPER,
    best_line,
    other_sweeper,
    prepare_other_sweeper,
    words_without_sweeper,
)
from gsbench.app.sweep import OWN, Sweep, TrialTask
from gsbench.claims.stopping import log_verdicts
from gsbench.config import compose
from gsbench.config.command_words import check_words, is_sweep, key_of, parse, parse_word
from gsbench.config.compose import Trial
from gsbench.config.trust import PERMISSIONS, load_callbacks
from gsbench.errors import GsbenchError, InputError
from gsbench.eval.options import EvalConfig
from gsbench.launch.batch import check_parts, missing_folders, need_no_check, run_batch
from gsbench.launch.dry_run import describe_plan
from gsbench.launch.jobs import Outcome
from gsbench.logs import set_up_logging

# the errors of Hydra for a user's words and files
HYDRA_ERRORS = (HydraException, OmegaConfBaseException, OSError)
HYDRAS_FILES = ("run", "sweep", "output_subdir")  # settings of Hydra's own files

log = logging.getLogger(__name__)


def launch(argv: list[str]) -> int:
    """Run the trials of a command line; returns 0 if all are done (or in Slurm), 1 if some failed.

    Raises InputError for a wrong configuration, and for a single trial's bad input.
    """
    words, multirun, dry_run = parse(argv)
    task = TrialTask(list_trials, look_only=True) if dry_run else TrialTask(run_batch)
    run_app(words, multirun, task)
    if dry_run or not task.trials:  # a sweep whose question is decided needs no trial
        return 0
    return summarize(task.outcomes, task.trials)


def compose_trials(
    words: Sequence[str], multirun: bool = False, typed: Sequence[str] | None = None
) -> list[Trial]:
    """The trials that a command line would run.

    Only the words ``typed`` by the user (default: all ``words``) give permissions.
    """
    task = TrialTask(lambda trials: [], look_only=True)
    run_app(words, multirun, task, typed)
    return task.trials


def one_trial_per_scene(verb: str, settings: Sequence[str], metric: str) -> dict[str, Trial]:
    """A trial of each scene, for a verb that compares two versions of one trainer (gate, bisect).

    Raises InputError for settings that make more than one arm, and for a metric that the trials do
    not compute.
    """
    keys = [word.partition("=")[0].lstrip("+") for word in settings]
    if implied := [key for key in keys if key in ("seed", "eval.primary")]:
        raise InputError(f"{verb}: {implied[0]} follows from the other words: leave it out")
    trials = compose_trials(
        [*settings, "seed=0", *([] if "name" in keys else [f"name={verb}"])], multirun=True
    )
    by_scene = {trial.values["scene"]["name"]: trial for trial in trials}
    if len(by_scene) < len(trials):
        raise InputError(f"{verb} is about one arm: only scene may list values")
    require_waiting(verb, trials)
    if metric not in COSTS:
        EvalConfig(**trials[0].values["eval"] | {"primary": metric})
    return by_scene


def require_waiting(verb: str, trials: Sequence[Trial]) -> None:
    """Raise InputError if ``trials``, whose results the verb needs, would only be submitted."""
    if not trials[0].values["launch"]["wait"]:
        raise InputError(f"{verb} waits for its trials: leave out launch.wait=false")


def run_trials(trials: Sequence[Trial]) -> int:
    """Run the ``trials`` that are not done, by their launcher; returns the exit code."""
    return summarize(run_batch(trials), trials)


def run_app(
    words: Sequence[str], multirun: bool, task: TrialTask, typed: Sequence[str] | None = None
) -> None:
    """Run ``task`` for a command line's trials: one, or many (``multirun``, an experiment).

    Only the words ``typed`` by the user (default: all) give permissions; others are for a task that
    only looks. Raises InputError with one line for a wrong configuration.
    """
    check_words(words)
    typed = words if typed is None else typed
    with compose.hydra_ready():
        config, multirun = _checked_config(words, multirun, typed)
        task.allowed = tuple(config[PERMISSIONS])
        other = other_sweeper(config) if multirun else ""
        if other and task.look_only:
            words, multirun = words_without_sweeper(config, words, other)
            if not multirun:
                task.handle = lambda trials: []  # trials with other values are not listed
            config, other = compose.compose_whole([*words, _mode_word(multirun)], typed), ""
        if not other:
            task.grids = OmegaConf.to_container(config.hydra.sweeper, resolve=False).get("grids")  # type: ignore[union-attr]
        # The grids are taken out: Hydra would resolve their ${…} when it makes the sweeper, before
        # each trial's values. Hydra 1.4 refuses a job whose sweeper differs from the sweep's.
        argv = [*words, *[f"{GRIDS}=[]"] * bool(task.grids)]
        if task.look_only:
            if task.grids:
                config = compose.compose_whole([*argv, _mode_word(multirun)], typed)
            with compose.explained(words, HYDRA_ERRORS):
                _look(config, words, multirun, task)
            return
    if other:
        argv = prepare_other_sweeper(config, argv, task, other)
    load_callbacks(config.hydra.callbacks, task.allowed)
    argv += words_for_hydras_files(config, words, multirun)
    if config.hydra.job.chdir:
        log.info(
            "hydra.job.chdir: paths still start in %s, where the command was given", task.folder
        )
    with compose.explained(words, HYDRA_ERRORS):
        try:
            compose.run_main(task, [*argv, _mode_word(multirun)], config)
        except (GsbenchError, *HYDRA_ERRORS):
            raise
        except Exception as error:
            if not other:
                raise
            message = " ".join(str(error).split())  # it may raise any error for its settings
            raise InputError(
                f"hydra/sweeper={other} raised {type(error).__name__}: {message}"
            ) from error
    if other and not task.trials:
        name = config.name
        log.info(
            "hydra/sweeper=%s has ended: gsbench status %s; the table: gsbench tables %s",
            other,
            name,
            name,
        )
    elif other not in ("", GRID_SWEEPER) and (best := best_line(task.trials, task.objective)):
        log.info("hydra/sweeper=%s: %s", other, best)


def _checked_config(
    words: Sequence[str], multirun: bool, typed: Sequence[str]
) -> tuple[DictConfig, bool]:
    """The whole configuration of ``words``, and whether it is a sweep."""
    # without -m, a file may say that it is a sweep
    config = compose.compose_whole([*words, _mode_word(True)] if multirun else words, typed)
    multirun = config.hydra.mode == RunMode.MULTIRUN
    swept = [word for word in words if is_sweep(word)]
    if swept and not multirun:
        raise InputError(f"{swept[0]} lists several values: add -m to run one trial for each")
    with compose.explained(words):
        check_sweep_settings(config, multirun)
    return config, multirun


def _look(config: DictConfig, words: Sequence[str], multirun: bool, task: TrialTask) -> None:
    """Hand the trials of a composed configuration to a ``task`` that only looks.

    Nothing runs, so no callback is called and Hydra writes nothing. That leaves nothing for
    `hydra.main` to do, which would compose the same configuration twice more.
    """
    set_up_logging(config.hydra.verbose)
    if not multirun:
        config.hydra.mode = RunMode.RUN  # as `hydra.main` sets these two
        config.hydra.runtime.output_dir = os.path.abspath(config.hydra.run.dir)
        task.launch([compose.resolve_trial(config, words)])
        return
    sweeper: Any = OmegaConf.to_container(config.hydra.sweeper, resolve=True)
    own_words = [word for word in words if not parse_word(word).is_hydra_override()]
    sweep = Sweep.plan(compose.config_loader(), task, config)
    run_sweep(sweep, sweeper["params"] or {}, sweeper["tune"] or {}, own_words)


def _mode_word(multirun: bool) -> str:
    return f"hydra.mode={'MULTIRUN' if multirun else 'RUN'}"


def words_for_hydras_files(config: DictConfig, words: Sequence[str], multirun: bool) -> list[str]:
    """The words by which Hydra writes its own files as in any app, if one of them was asked for.

    Otherwise Hydra writes nothing, since each trial's folder has its configuration and log.
    """
    node, own = (OmegaConf.to_container(config.hydra, resolve=False), compose.installed_nodes(()))
    assert isinstance(node, dict)
    logs = node["job_logging"].get("root")
    if not logs and all(node[key] == own[key] for key in HYDRAS_FILES):
        return []
    typed = {key_of(word) for word in words}
    added = {}
    if node["output_subdir"] is None and "hydra.output_subdir" not in typed:
        added["hydra.output_subdir"] = ".hydra"
    if not logs and "hydra/job_logging" not in typed:
        added |= {"hydra/job_logging": "default", "hydra.job_logging.root.handlers": "[file]"}
    if node["run"] == own["run"]:
        added["hydra.run.dir"] = "${runs}/.hydra"
    if multirun and node["sweep"]["subdir"] == own["sweep"]["subdir"]:
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


def list_trials(trials: Sequence[Trial]) -> list[Outcome]:
    """Print the trials with their states, and the folders that are missing; run none."""
    if not need_no_check(trials):
        check_parts(trials, on_this_machine=False)
    lines = describe_plan(trials, trials[0].values["launch"]["parallel"])
    print("\n".join([*lines, *missing_folders(trials)]))
    return []


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


def summarize(outcomes: Sequence[Outcome], trials: Sequence[Trial]) -> int:
    """Report how trials ended: 0 if all are done, 1 if some failed, 2 if all had bad input.

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
    if len(outcomes) > 1 and done == len(outcomes):
        log_verdicts(trials)
    if failed and all(outcome.status == "failed" and outcome.bad_input for outcome in outcomes):
        return 2
    return 1 if failed else 0
