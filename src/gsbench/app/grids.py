"""gsbench's own sweeper: the trials that lists, intervals and joined grids span.

They run as one batch, or seed by seed until their question is decided. A sweep may first tune its
arms (`gsbench.app.tuning`).
"""

import itertools
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra.core.override_parser.types import Override
from omegaconf import OmegaConf

from gsbench.analysis.questions import plan_looks
from gsbench.analysis.results import read_experiment
from gsbench.app.sweep import Run, Sweep
from gsbench.app.tuning import tuned_jobs
from gsbench.claims.stopping import Needed, SequentialTest, log_verdicts
from gsbench.config.command_words import grid_points, is_interval
from gsbench.config.compose import Trial
from gsbench.config.overrides import bare_key, is_sweep, key_of, task_words, value_text
from gsbench.errors import InputError
from gsbench.files import make_runs_folder
from gsbench.launch.record import check_looks, planned_rows, record
from gsbench.runs.layout import RESULTS

GRIDS = "hydra.sweeper.grids"
log = logging.getLogger(__name__)

# for a setting that only some of the listed choices may have
GRIDS_ADVICE = (
    f"give each choice its own settings, as '{GRIDS}=[{{densify: adc}}, {{densify: volumetric, "
    'densify.volume_threshold: "0.01,0.03"}]\''
)


def run_sweep(sweep: Sweep, run: Run) -> None:
    """Run the trials of a command by gsbench's own sweeper, perhaps in looks."""
    trials, _ = planned_trials(sweep, run)
    if any(trial.values["launch"]["stop_when_decided"] for trial in trials):
        _run_until_decided(trials, run)
    else:
        run(trials)


def planned_trials(sweep: Sweep, run: Run | None) -> tuple[list[Trial], bool]:
    """The trials of a command, and whether these are known, or depend on a search to come.

    ``hydra.sweeper.tune`` says how intervals are searched first, by trials that ``run`` runs; with
    None, in a dry run, only their plan is printed.
    """
    if not sweep.multirun:
        return [sweep.trial(sweep.words)], True
    node, given = sweep.config.hydra.sweeper, task_words(sweep.words)
    tune: Any = OmegaConf.to_container(node.tune, resolve=True)
    params: Any = OmegaConf.to_container(node.params, resolve=True) if node.params else {}
    # not resolved: their ${…} are for each trial's values
    raw: Any = OmegaConf.to_container(node, resolve=False)
    grids = checked_grids(raw["grids"] or [])
    jobs: list[list[str]] = []
    # for each job, the settings that are searched for its arm
    intervals: list[dict[str, Override]] = []
    for grid_words in words_of_grids(params, grids, given):
        own = {bare_key(word.get_key_element()): word for word in sweep.parse(grid_words)}.values()
        points = grid_points([word for word in own if not is_interval(word)])
        jobs += points
        searched = {word.get_key_element(): word for word in own if is_interval(word)}
        intervals += [searched] * len(points)
    try:
        jobs, are_known = tuned_jobs(sweep, tune or {}, jobs, intervals, run)
        trials = sweep.trials(jobs)
    except InputError as error:
        keys = [key_of(word) for word in given]
        groups = {key_of(word) for word in given if is_sweep(word)}
        if grids or not any("." in key and key.partition(".")[0] in groups for key in keys):
            raise
        raise InputError(f"{error}; {GRIDS_ADVICE}") from error
    if run is None and any(trial.values["launch"]["stop_when_decided"] for trial in trials):
        seeds = check_looks(trials, planned_rows(trials))
        print(f"stops when decided: looks at {', '.join(map(str, plan_looks(len(seeds))))} seeds")
    return trials, are_known


def _run_until_decided(trials: Sequence[Trial], run: Run) -> None:
    """Run the trials in the looks that the sequential test plans.

    Decided pairs of arms get no further trials. Raises InputError for a sweep that cannot be tested
    in this way.
    """
    rows = planned_rows(trials)
    check_looks(trials, rows)
    make_runs_folder(trials[0].values["runs"])
    questions = record(trials)
    if not questions:
        raise InputError(
            "launch.stop_when_decided compares arms, and this sweep has one: give two densifiers"
        )
    by_place = {
        (row.scene, row.digest, row.seed): trial for row, trial in zip(rows, trials, strict=True)
    }
    home = trials[0].files.home
    launched: set[Path] = set()

    def run_planned(planned: Sequence[Needed]) -> None:
        batch = [by_place[key] for key in planned if key in by_place]
        batch = [trial for trial in batch if trial.folder not in launched]
        launched.update(trial.folder for trial in batch)
        if batch:
            run(batch)

    SequentialTest(tuple(questions), lambda: read_experiment(home).trials).answer(run_planned)
    if not launched:  # else it is said when the trials' outcomes are
        log_verdicts(trials)
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
    for key, value in itertools.chain(*(grid.items() for grid in grids)):
        if value is None or isinstance(value, list | dict):
            raise InputError(
                f"{GRIDS}: {key} must list values as on the command line, such as 1,2,3, got "
                f"{value!r}"
            )
    return [{str(key): value_text(value) for key, value in grid.items()} for grid in grids]


def words_of_grids(
    params: Mapping[str, Any], grids: Sequence[Mapping[str, str]], given: Sequence[str]
) -> list[list[str]]:
    """The words of each grid: its own, the shared ``params``, and those ``given`` for it.

    If two words set one key, the later one counts, with the plus of a grid's own word. Trials are
    in the order of the grids; the shared settings vary fastest.
    """
    listed = set(map(bare_key, itertools.chain(*grids)))
    jobs = []
    for grid in grids or [{}]:
        of_grid = set(map(bare_key, grid))
        shared = {key: value for key, value in params.items() if bare_key(key) not in of_grid}
        settings = {**grid, **shared}
        words = [f"{key}={value}" for key, value in settings.items()]
        signed = {bare_key(key): key for key in settings}
        for word in given:
            key = key_of(word)
            if key not in listed - of_grid:
                sign = "" if word[0] in "+~" else signed.get(key, key).removesuffix(key)
                words.append(sign + word)
        jobs.append(words)
    return jobs
