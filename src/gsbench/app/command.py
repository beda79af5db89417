"""gsbench as a Hydra app: a command line becomes trials and an exit code.

Before Hydra runs, the whole configuration is composed and checked (`gsbench.config.compose`). Then
``hydra.main`` runs the task once, or hands it to gsbench's sweeper. A sweep may first tune its arms
(`gsbench.app.tuning`). Its trials run as one batch, or seed by seed until their question is
decided.
"""

import itertools
import logging
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gsbench.analysis.quantities import COSTS
from gsbench.app.sweep import OWN, Objective, Sweep, TrialTask, metric_of
from gsbench.app.tuning import tuned_jobs
from gsbench.claims.stopping import KeyAndSeed, headline, plan_sweep, run_looks
from gsbench.config import compose
from gsbench.config.command_words import (
    bare_key,
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
from gsbench.config.trust import PERMISSIONS, load_callbacks
from gsbench.errors import GsbenchError, InputError
from gsbench.eval.options import EvalConfig
from gsbench.files import checked_runs_folder, make_runs_folder
from gsbench.launch.batch import check_parts, missing_folders, need_no_check, run_batch
from gsbench.launch.jobs import Outcome
from gsbench.launch.record import declare_questions
from gsbench.launch.states import describe_plan
from gsbench.runs.layout import RESULTS

GRIDS = "hydra.sweeper.grids"

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


def compose_trials(words: Sequence[str], multirun: bool = False) -> list[Trial]:
    """The trials that a command line would run."""
    task = TrialTask(lambda trials: [], look_only=True)
    run_app(words, multirun, task)
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


def run_app(words: Sequence[str], multirun: bool, task: TrialTask) -> None:
    """Run ``task`` for a command line's trials: one, or many (``multirun``, an experiment).

    Raises InputError with one line for a wrong configuration.
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
    other = other_sweeper(config) if multirun else ""
    if other and task.look_only:
        words, multirun = words_without_sweeper(config, words, other)
        if not multirun:
            task.handle = lambda trials: []  # trials with other values are not listed
        other = ""
    sweeper = config.hydra.sweeper
    task.grids = None if other else OmegaConf.to_container(sweeper, resolve=False).get("grids")  # type: ignore[union-attr]
    # The grids are taken out: Hydra would resolve their ${…} when it makes the sweeper, before each
    # trial's values.
    argv = [*words, *[f"{GRIDS}=[]"] * bool(task.grids)]
    if other:
        argv = prepare_other_sweeper(config, argv, task, other)
    if task.look_only:  # nothing runs, so no callback is called, and Hydra writes nothing
        argv = [word for word in argv if not key_of(word).startswith(LOGGING)] + NO_FILES
        argv += [f"~hydra.callbacks.{name}" for name in config.hydra.callbacks]
    else:
        load_callbacks(config.hydra.callbacks, task.allowed)
        argv += words_for_hydras_files(config, words, multirun)
        if config.hydra.job.chdir:
            log.info(
                "hydra.job.chdir: paths still start in %s, where the command was given", task.folder
            )
    # Another sweeper may raise any error for its settings.
    errors = Exception if other else (HydraException, OmegaConfBaseException, OSError)
    with compose.explained(words, errors):
        compose.run_main(task, [*argv, f"hydra.mode={'MULTIRUN' if multirun else 'RUN'}"], config)
    if other and not task.trials:
        name = config.name
        log.info(
            "hydra/sweeper=%s has ended: gsbench status %s; the table: gsbench tables %s",
            other,
            name,
            name,
        )


# ---- Hydra's other sweepers, and its own files

GRID_SWEEPER = "basic"  # Hydra's own, which expands lists and asks for no values
LOGGING = ("hydra/job_logging", "hydra/hydra_logging", "hydra.job_logging", "hydra.hydra_logging")
NO_FILES = [
    "hydra/job_logging=none",
    "hydra/hydra_logging=none",
    "hydra.run.dir=.",
    "hydra.output_subdir=null",
]
HYDRAS_FILES = ("run", "sweep", "output_subdir")
MAX_CHOICES = 1000  # of groups, in a sweep of another sweeper


def other_sweeper(config: DictConfig) -> str:
    """The name of the chosen sweeper; empty if it is gsbench's."""
    name = str(config.hydra.runtime.choices["hydra/sweeper"])
    return "" if name == OWN else name


def words_without_sweeper(
    config: DictConfig, words: Sequence[str], name: str
) -> tuple[list[str], bool]:
    """The words of a dry run of another sweeper, and whether they are a sweep."""
    kept = [
        word for word in words if not key_of(word).startswith(("hydra/sweeper", "hydra.sweeper."))
    ]
    if name == GRID_SWEEPER:
        return [*kept, f"hydra/sweeper={OWN}"], True
    points = config.hydra.sweeper.get("n_trials")
    count = "trials" if points is None else f"{points} trials (hydra.sweeper.n_trials)"
    print(
        f"hydra/sweeper={name} searches: it proposes {count} from the results, so they are not "
        "known yet"
    )
    return [*(word for word in kept if not is_sweep(word)), f"hydra/sweeper={OWN}"], False


def prepare_other_sweeper(
    config: DictConfig, words: Sequence[str], task: TrialTask, name: str
) -> list[str]:
    """Set the objective of the ``task`` for another sweeper; returns the words for Hydra.

    Raises InputError for a choice among the words that would run what is not allowed: Hydra reads a
    job's logging before the job can be checked.
    """
    params = config.hydra.sweeper.get("params") or {}
    lists = {bare_key(str(key)): f"{key}={value}" for key, value in params.items()}
    lists |= {key_of(word): word for word in words if is_sweep(word)}
    choices = [
        grid_points([parse_word(word)])
        for key, word in lists.items()
        if "." not in key and key != "seed"
    ]
    for number, point in enumerate(product(*choices)):
        if number == MAX_CHOICES:
            raise InputError(
                f"hydra/sweeper={name}: more than {MAX_CHOICES} combinations of choices"
            )
        with compose.hydra_ready():
            compose.compose_whole(
                [*(w for w in words if not is_sweep(w)), *(word for (word,) in point)]
            )
    if name == GRID_SWEEPER:
        task.objective = Objective(-1)
        return list(words)
    with compose.hydra_ready():
        metric, direction = metric_of(compose.resolve_trial(config, words).values)
    sign = 1 if _maximizes(config.hydra.sweeper) else -1
    # A search must not choose among seeds: each job has them all.
    seeds = (
        [word for (word,) in grid_points([parse_word(lists["seed"])])] if "seed" in lists else []
    )
    task.objective = Objective(sign, tuple(seeds))
    log.info(
        "hydra/sweeper=%s gets %s%s of test views, %s; gsbench's own sweeper would tune on "
        "validation views and can stop by looks",
        name,
        "-" if sign != direction else "",
        metric,
        "maximized" if sign > 0 else "minimized",
    )
    kept = [word for word in words if key_of(word) != "seed" or not is_sweep(word)]
    return kept + ["~hydra.sweeper.params.seed"] * ("seed" in params)


def _maximizes(sweeper: DictConfig) -> bool:
    """Return whether a sweeper (Optuna, Nevergrad, Ax) was told to look for the largest value."""
    direction = sweeper.get("direction")
    name = str(getattr(direction, "name", direction)).lower()
    nevergrad, ax = (
        OmegaConf.select(sweeper, key)
        for key in ("optim.maximize", "ax_config.experiment.minimize")
    )
    return name == "maximize" or nevergrad is True or ax is False


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
    if failed and all(outcome.status == "failed" and outcome.bad_input for outcome in outcomes):
        return 2
    return 1 if failed else 0


# ---- sweeps


def run_sweep(
    sweep: Sweep, params: Mapping[str, Any], tune: Mapping[str, Any], words: Sequence[str]
) -> None:
    """Run all points that ``words`` and ``params`` (``hydra.sweeper.params``) span.

    ``tune`` (``hydra.sweeper.tune``) says how intervals among them are searched first
    (`gsbench.app.tuning`).
    """
    grids = checked_grids(sweep.task.grids or [])
    jobs: list[list[str]] = []
    # for each job, the settings that are searched for its arm
    intervals: list[dict[str, Override]] = []
    for grid_words in words_of_grids(params, grids, words):
        by_key = {
            bare_key(override.get_key_element()): override for override in sweep.parse(grid_words)
        }
        points = grid_points(
            [override for override in by_key.values() if not is_interval(override)]
        )
        jobs += points
        searched = {
            override.get_key_element(): override
            for override in by_key.values()
            if is_interval(override)
        }
        intervals += [searched] * len(points)
    trials = sweep.trials(tuned_jobs(sweep, tune, jobs, intervals))
    if any(trial.values["launch"]["stop_when_decided"] for trial in trials):
        _run_until_decided(sweep, trials)
    else:
        sweep.launch(trials)


def _run_until_decided(sweep: Sweep, trials: Sequence[Trial]) -> None:
    """Run the trials in the looks that the sequential test plans.

    Decided pairs of arms get no further trials. Raises InputError for a sweep that cannot be tested
    in this way.
    """
    stopping = plan_sweep(trials)
    if sweep.task.look_only:
        print(stopping.describe())
        sweep.launch(trials)
        return
    make_runs_folder(checked_runs_folder(trials[0].values["runs"]))
    stopping = replace(stopping, declaration=declare_questions(stopping.home, stopping.declaration))
    launched: set[Path] = set()

    def run(planned: Sequence[KeyAndSeed]) -> None:
        batch = [trial for key in planned if (trial := stopping.trials[key]).folder not in launched]
        launched.update(trial.folder for trial in batch)
        if batch:
            sweep.launch(batch)

    for verdict in run_looks(stopping.declaration, stopping.judged, run):
        log.info("%s", headline(verdict))
    spared = [
        trial
        for trial in trials
        if trial.folder not in launched and not (trial.folder / RESULTS).exists()
    ]
    log.info("%d of %d trials were not needed", len(spared), len(trials))


# ---- grids
#
# An experiment's file may join several grids. Each maps settings to values, and all share the
# settings of ``hydra.sweeper.params``:
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
# If some grids list the setting of a word of the command line, the word replaces their values and
# does not reach the other grids. Any other word is for all grids.


def checked_grids(grids: Any) -> list[dict[str, str]]:
    """The grids of the configuration, with values as texts.

    Raises InputError unless they are a list of mappings.
    """
    if not isinstance(grids, list) or not all(isinstance(grid, dict) and grid for grid in grids):
        raise InputError(
            f"{GRIDS} must be a list, each a mapping of settings to values, got {grids!r}"
        )
    return [{str(key): _text(key, value) for key, value in grid.items()} for grid in grids]


def words_of_grids(
    params: Mapping[str, Any], grids: Sequence[Mapping[str, str]], given: Sequence[str]
) -> list[list[str]]:
    """The words of each grid: its own, the shared ``params``, and those ``given`` for it.

    If two words set one key, the later one counts. Trials are in the order of the grids; the shared
    settings vary fastest.
    """
    listed = set(map(bare_key, itertools.chain(*grids)))
    jobs = []
    for grid in grids or [{}]:
        own = set(map(bare_key, grid))
        shared = {key: value for key, value in params.items() if bare_key(key) not in own}
        words = [f"{key}={value}" for key, value in (*grid.items(), *shared.items())]
        jobs.append([*words, *(word for word in given if key_of(word) not in listed - own)])
    return jobs


def _text(key: object, value: object) -> str:
    if value is None or isinstance(value, list | dict):
        raise InputError(
            f"{GRIDS}: {key} must list values as on the command line, such as 1,2,3, got {value!r}"
        )
    return value_text(value)
