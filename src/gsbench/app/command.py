"""Trials: from a command line to outcomes, and the exit code that they amount to."""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence

from gsbench.app.hydra_app import run_app
from gsbench.app.task import StopAfterListing, Task
from gsbench.config.command_words import parse
from gsbench.errors import GsbenchError, InputError
from gsbench.launch.batch import run_batch
from gsbench.launch.outcome import Outcome
from gsbench.launch.plan import describe_plan
from gsbench.launch.preflight import check_parts, missing_folders, need_no_check
from gsbench.launch.trial import Trial

log = logging.getLogger(__name__)


def launch(argv: list[str]) -> int:
    """Run the trials of the command line ``argv``; 0 if all are done (or left to Slurm), 1 if some failed.

    Raises InputError for a configuration that does not compose or hold together, and for a single trial's bad input.
    """
    words, multirun, dry_run = parse(argv)
    task = Task(list_trials, look_only=True) if dry_run else Task(run_batch)
    run_app(words, multirun, task)
    if dry_run or not task.trials:  # a sweep that is decided needs none
        return 0
    return summarize(task.outcomes, task.trials)


def list_trials(trials: Sequence[Trial]) -> list[Outcome]:
    """Print the trials with their states, and what they will miss; run none."""
    if not need_no_check(trials):
        check_parts(trials, here=False)
    print("\n".join(describe_plan(trials, trials[0].values["launch"]["parallel"]) + missing_folders(trials)))
    raise StopAfterListing


def run_trials(trials: Sequence[Trial]) -> int:
    """Run what is not done among ``trials`` by the launcher that they name; the exit code."""
    return summarize(run_batch(trials), trials)


def summarize(outcomes: Sequence[Outcome], trials: Sequence[Trial]) -> int:
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
    name = trials[-1].values["name"]  # a tuning comes before, in experiments of its own
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
