"""A command line becomes trials and an exit code.

It is read once (`gsbench.app.sweep`), and its trials are composed. Then they are listed, run by
gsbench's own sweeper (`gsbench.app.grids`), or by what of Hydra's the command asks for
(`gsbench.app.hydra_app`).
"""

import logging
import os
import sys
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress

from gsbench.analysis.quantities import COSTS
from gsbench.app.grids import planned_trials, run_sweep
from gsbench.app.hydra_app import run_by_hydra, words_without_sweeper
from gsbench.app.sweep import HYDRA_ERRORS, Ended, Sweep
from gsbench.claims.stopping import log_verdicts
from gsbench.config.command_words import parse
from gsbench.config.compose import Trial
from gsbench.config.explain import explained
from gsbench.errors import InputError
from gsbench.eval.options import EvalConfig
from gsbench.launch.batch import check_parts, missing_folders, need_no_check, run_batch
from gsbench.launch.estimates import describe_plan
from gsbench.launch.jobs import Outcome
from gsbench.launch.record import check_questions, forget_refused
from gsbench.words import command, counted

log = logging.getLogger(__name__)


def launch(argv: list[str]) -> int:
    """Run the trials of a command line; returns 0 if all are done (or in Slurm), 1 if some failed.

    Raises InputError for a wrong configuration, and for a single trial's bad input.
    """
    words, multirun, is_dry_run = parse(argv)
    sweep = Sweep(words, multirun)
    # Trials run in this block, so only Hydra's errors are about the words.
    with explained(words, HYDRA_ERRORS):
        if is_dry_run:
            trials, are_known = trials_of(sweep)
            if are_known:  # those that a search will choose are only described
                check_questions(trials)
                list_trials(trials)
            return 0
        if sweep.config.hydra.job.chdir:
            log.info("hydra.job.chdir: paths still start in %s, as the command does", os.getcwd())
        ended = run_by_hydra(sweep, run_batch)
        if ended is None:
            own = ended = Ended()
            run_sweep(sweep, lambda trials: own.add(trials, run_batch(trials)))
    if not ended.trials:  # a sweep whose question is decided needs no trial
        return 0
    if all(outcome.status == "failed" and outcome.bad_input for outcome in ended.outcomes):
        with suppress(OSError):
            forget_refused(ended.trials)
    return summarize(ended.outcomes, ended.trials)


def compose_trials(
    words: Sequence[str], multirun: bool = False, typed: Sequence[str] | None = None
) -> list[Trial]:
    """The trials that a command line would run.

    Only the words ``typed`` by the user (default: all ``words``) give permissions.
    """
    sweep = Sweep(words, multirun, typed)
    with explained(words, HYDRA_ERRORS):
        return trials_of(sweep)[0]


def trials_of(sweep: Sweep) -> tuple[list[Trial], bool]:
    """The trials that a command would run, and whether they are known before it runs.

    Nothing runs, so no callback is called and Hydra writes nothing.
    """
    if not sweep.other_sweeper:
        return planned_trials(sweep, None)
    words, is_grid = words_without_sweeper(sweep)
    trials, are_known = trials_of(Sweep(words, is_grid, sweep.typed))
    return trials, are_known and is_grid


def one_trial_per_scene(verb: str, settings: Sequence[str], metric: str) -> dict[str, Trial]:
    """A trial of each scene, for a verb that compares two versions of one trainer (gate).

    Raises InputError for settings that make more than one arm, and for a metric that the trials do
    not compute.
    """
    keys = [word.partition("=")[0].lstrip("+") for word in settings]
    if implied := [key for key in keys if key in ("seed", "eval.primary")]:
        raise InputError(f"{verb}: {implied[0]} follows from the other words: leave it out")
    # any seed will do: the verb runs as many as its question needs
    trials = compose_trials(
        [*settings, "seed=0", *([] if "name" in keys else [f"name={verb}"])], multirun=True
    )
    by_scene = {trial.values["scene"]["name"]: trial for trial in trials}
    if len(by_scene) < len(trials):
        raise InputError(f"{verb} is about one arm: only scene may list values")
    require_waiting(verb, trials)
    if metric not in COSTS:  # raises for a metric that the trials would not compute
        EvalConfig(**trials[0].values["eval"] | {"primary": metric})
    return by_scene


def require_waiting(verb: str, trials: Sequence[Trial]) -> None:
    """Raise InputError if ``trials``, whose results the verb needs, would only be submitted."""
    if not trials[0].values["launch"]["wait"]:
        raise InputError(f"{verb} waits for its trials: leave out launch.wait=false")


def run_trials(trials: Sequence[Trial], asks: bool = True) -> int:
    """Run the ``trials`` that are not done, by their launcher; returns the exit code.

    With ``asks``, their questions are written down first.
    """
    return summarize(run_batch(trials, asks), trials)


def list_trials(trials: Sequence[Trial]) -> None:
    """Print the trials with their states, and the folders that are missing; run none."""
    # Making the parts loads torch, which takes seconds.
    if not need_no_check(trials):
        check_parts(trials, on_this_machine=False)
    lines = describe_plan(trials, trials[0].values["launch"]["parallel"])
    print("\n".join([*lines, *missing_folders(trials)]))


def summarize(outcomes: Sequence[Outcome], trials: Sequence[Trial]) -> int:
    """Report how trials ended: 0 if all are done, 1 if some failed, 2 if all had bad input.

    A single trial's failure is raised, so that the program prints this one line only.
    """
    failed = [outcome for outcome in outcomes if outcome.status == "failed"]
    if failed and len(outcomes) == 1:
        raise failed[0].error
    for outcome in failed:
        if not outcome.change:
            print(f"gsbench: failed: {outcome.label}: {outcome.message}", file=sys.stderr)
    changes = Counter(outcome.change for outcome in failed if outcome.change)
    for setting, count in changes.items():
        print(
            f"gsbench: not started: {counted(count, 'trial')} would fail in the same way: change "
            f"{setting}, then give the command again",
            file=sys.stderr,
        )
    name = trials[-1].values["name"]  # the last one's: a tuning runs before, in its own experiments
    done = sum(outcome.status == "done" for outcome in outcomes)
    must_change = changes or all(outcome.bad_input for outcome in failed)
    if any(outcome.status == "queued" for outcome in outcomes):
        advice = f"how far the others are: {command('status', name)}"
    elif failed and must_change:  # a retry would fail again
        advice = "change what the lines above name, then give the command again"
    else:
        advice = command("retry" if failed else "tables", name)
        advice = f"{'again' if failed else 'the table'}: {advice}"
        if len(outcomes) == 1:
            advice += f"; renders and model: {outcomes[0].folder}"
    log.info("%d of %d trials done; %s", done, len(outcomes), advice)
    if len(outcomes) > 1 and done == len(outcomes):
        log_verdicts(trials)
    if failed and all(outcome.status == "failed" and outcome.bad_input for outcome in outcomes):
        return 2
    return 1 if failed else 0
