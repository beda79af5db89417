"""Trials: from a command line to a plan, from the plan to outcomes, and the exit code that they amount to."""

from __future__ import annotations

import json
import logging
import os
import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

from gsbench.command_words import parse
from gsbench.compose import Composed, compose_trials
from gsbench.errors import GsbenchError, InputError
from gsbench.files import checked_runs_folder, make_runs_folder, storage_errors
from gsbench.launch.outcome import Outcome, outcome_of_results
from gsbench.launch.plan import add_to_plan, describe_plan
from gsbench.launch.preflight import check_components, missing_folders, missing_weights, need_no_check
from gsbench.launch.queries import QUERIES, ask_hydra
from gsbench.launch.serial import run_serial
from gsbench.layout import STORE
from gsbench.pipeline.stages import STAGES
from gsbench.pipeline.stopping import stop_on_signals
from gsbench.pipeline.store import Store
from gsbench.pipeline.trial_files import TrialPaths, find_finished

log = logging.getLogger(__name__)


def launch(argv: list[str]) -> int:
    """Run the trials of the command line ``argv``; 0 if all are done (or left to Slurm), 1 if some failed.

    Raises InputError for a configuration that does not compose or hold together, and for a single trial's bad input.
    """
    sys.path.insert(0, os.getcwd())  # a user's own class lies beside the user
    if any(word.split("=")[0] in QUERIES for word in argv):
        return ask_hydra(argv)
    overrides, multirun, dry_run = parse(argv)
    trials = compose_trials(overrides, multirun)
    if dry_run:
        if not need_no_check(trials):
            check_components(trials, here=False)
        print("\n".join(describe_plan(trials, trials[0].values["launch"]["parallel"]) + missing_folders(trials)))
        return 0
    return run_trials(trials)


def run_trials(trials: Sequence[Composed]) -> int:
    """Run what is not done among ``trials`` by the launcher that they name; the exit code."""
    runs, launcher = checked_runs_folder(trials[0].values["runs"]), trials[0].values["launch"]["name"]
    with storage_errors(runs), stop_on_signals():
        if launcher != "slurm" and (missing := missing_weights(trials)):  # also where all is done and none is needed
            raise InputError("; ".join(missing))
        outcomes, unfinished = _skip_finished(trials)
        # A node of a cluster may have folders and devices that this machine lacks.
        if launcher != "slurm" and (missing := missing_folders(unfinished)):
            raise InputError("; ".join(missing))
        check_components(unfinished, here=launcher != "slurm")
        make_runs_folder(runs)
        Store(runs / STORE).sweep(STAGES)
        add_to_plan(trials)
        if unfinished:
            if launcher == "serial":
                outcomes += run_serial(unfinished)
            elif launcher == "local":
                from gsbench.launch.jobs import run_local

                outcomes += run_local(unfinished)
            else:
                from gsbench.launch.slurm import run_slurm

                outcomes += run_slurm(unfinished)
    return summarize(outcomes, trials)


def _skip_finished(trials: Sequence[Composed]) -> tuple[list[Outcome], list[Composed]]:
    outcomes: list[Outcome] = []
    unfinished: list[Composed] = []
    seen: set[Path] = set()
    for trial in trials:
        folder = TrialPaths.of(trial.values).folder
        if folder in seen:  # a sweep may list a value twice
            continue
        seen.add(folder)
        results = find_finished(trial.values, _unavailable_metrics)
        if results is None:
            unfinished.append(trial)
        else:
            outcomes.append(outcome_of_results(folder, results))
            log.info("%s: was done  %s", outcomes[-1].label, outcomes[-1].message)
    return outcomes, unfinished


def _unavailable_metrics(options: dict[str, Any]) -> frozenset[str]:
    return _unavailable(json.dumps(options, sort_keys=True))


@cache
def _unavailable(options: str) -> frozenset[str]:
    """The metrics that cannot be computed here and now; weights are looked for, and fetched, once for a sweep."""
    from gsbench.config import EvalConfig
    from gsbench.pipeline.components import make_evaluator

    return frozenset(make_evaluator(EvalConfig(**json.loads(options))).awaited)


def summarize(outcomes: Sequence[Outcome], trials: Sequence[Composed]) -> int:
    """Say how the trials ended; 0 if all are done, 1 if some failed, 2 if all failed for bad input.

    A single trial's failure is raised, so that it is the one line that the program prints.
    """
    failed = [outcome for outcome in outcomes if outcome.status == "failed"]
    fatal = next((outcome for outcome in failed if outcome.fatal), None)
    if failed and (fatal or len(outcomes) == 1):
        worst = fatal or failed[0]
        raise (InputError if worst.bad_input else GsbenchError)(worst.message)
    for outcome in failed:
        print(f"gsbench: failed: {outcome.label}: {outcome.message}", file=sys.stderr)
    name = trials[0].values["name"]
    done = sum(outcome.status == "done" for outcome in outcomes)
    if any(outcome.status == "queued" for outcome in outcomes):
        advice = f"how far the others are: gsbench status {name}"
    else:
        advice = f"again: gsbench retry {name}" if failed else f"the table: gsbench tables {name}"
    log.info("%d of %d trials done; %s", done, len(outcomes), advice)
    if failed and all(outcome.status == "failed" and outcome.bad_input for outcome in outcomes):
        return 2
    return 1 if failed else 0
