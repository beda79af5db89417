"""A batch of trials: skip what is done, check the rest before any work, run it; how each ended."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

from gsbench.config.compose import Trial
from gsbench.errors import InputError
from gsbench.files import FORBIDDEN, checked_runs_folder, make_runs_folder, storage_errors
from gsbench.launch.declare import declare, declared_metrics, planned_trials
from gsbench.launch.outcome import Outcome, outcome_of_results
from gsbench.launch.plan import add_to_plan
from gsbench.launch.preflight import (
    borrowed_names,
    check_parts,
    check_trackers,
    disk_line,
    missing_folders,
    missing_weights,
)
from gsbench.launch.serial import run_serial
from gsbench.runs.layout import STORE
from gsbench.runs.stages import STAGES
from gsbench.runs.store import Store
from gsbench.system.stopping import stop_on_signals
from gsbench.tracking import Mirror

log = logging.getLogger(__name__)


def run_batch(trials: Sequence[Trial]) -> list[Outcome]:
    """Run what is not done among ``trials`` by the launcher that they name; how each ended."""
    runs, launcher = checked_runs_folder(trials[0].values["runs"]), trials[0].values["launch"]["name"]
    with storage_errors(runs), stop_on_signals():
        if launcher != "slurm" and (missing := missing_weights(trials)):  # also where all is done and none is needed
            raise InputError("; ".join(missing))
        outcomes, unfinished = _skip_finished(trials)
        _begin(trials, unfinished)
        return outcomes + (_run(unfinished, launcher) if unfinished else [])


def _run(trials: Sequence[Trial], launcher: str) -> list[Outcome]:
    if launcher == "slurm":
        from gsbench.launch.slurm import run_slurm

        return run_slurm(trials)
    with Mirror() as mirror:
        if launcher == "serial":
            return run_serial(trials, mirror)
        from gsbench.launch.jobs import run_local

        return run_local(trials, mirror)


def begin_for_another_launcher(trials: Sequence[Trial]) -> None:
    """Do all that precedes the first trial where another launcher will run them, perhaps several at once."""
    values = trials[0].values
    with storage_errors(checked_runs_folder(values["runs"])):
        _begin(trials, [trial for trial in trials if _why_not_done(trial)])


def _begin(trials: Sequence[Trial], unfinished: Sequence[Trial]) -> None:
    """Refuse what can be known to fail, then make the runs folder, tidy the store, write plan and declaration."""
    metrics = declared_metrics(trials)
    runs, launcher = checked_runs_folder(trials[0].values["runs"]), trials[0].values["launch"]["name"]
    # A node of a cluster may have folders and devices that this machine lacks.
    if launcher != "slurm" and (missing := missing_folders(unfinished)):
        raise InputError("; ".join(missing))
    check_parts(unfinished, here=launcher != "slurm")
    if launcher != "slurm":
        check_trackers(unfinished)
    for line in [*borrowed_names(unfinished), disk_line(unfinished)]:
        if line:
            log.warning("%s", line)
    try:
        make_runs_folder(runs)
    except OSError as error:
        if unfinished or error.errno not in FORBIDDEN:
            raise
        log.info("%s may not be written to (%s), so its plan stays as it is", runs, error.strerror)
        return
    Store(runs / STORE).sweep(STAGES)
    add_to_plan(trials)
    declare(metrics, planned_trials(trials))


def _skip_finished(trials: Sequence[Trial]) -> tuple[list[Outcome], list[Trial]]:
    outcomes: list[Outcome] = []
    unfinished: list[Trial] = []
    seen: set[Path] = set()
    for trial in trials:
        folder = trial.folder
        if folder in seen:  # a sweep may list a value twice
            continue
        seen.add(folder)
        if not _why_not_done(trial):
            outcomes.append(outcome_of_results(folder, trial.files.record()))
            log.info("%s: was done  %s", outcomes[-1].label, outcomes[-1].message)
        else:
            unfinished.append(trial)
    return outcomes, unfinished


def _why_not_done(trial: Trial) -> str:
    return trial.files.why_not_done(trial.values, _unavailable_metrics)


def _unavailable_metrics(options: dict[str, Any]) -> frozenset[str]:
    return _unavailable(json.dumps(options, sort_keys=True))


@cache
def _unavailable(options: str) -> frozenset[str]:
    """The metrics that cannot be computed here and now; weights are looked for, and fetched, once for a sweep."""
    from gsbench.eval.options import EvalConfig
    from gsbench.pipeline.parts import make_evaluator

    return frozenset(make_evaluator(EvalConfig(**json.loads(options))).awaited)
