"""Verbs about trials: ``status``, ``retry``, ``declare``, and ``clean`` about what they stored."""

from __future__ import annotations

import argparse
import json
import logging
import os
import re
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from rich.live import Live
from rich.text import Text

from gsbench.config.command_words import makes_other_trials, parse, typed_permissions
from gsbench.config.compose import Trial, compose_one
from gsbench.config.overrides import changed_words, key_of
from gsbench.config.schema import check
from gsbench.errors import InputError
from gsbench.files import make_runs_folder
from gsbench.launch.estimates import describe_plan
from gsbench.launch.record import check_looks, check_questions, planned_rows, record, remove
from gsbench.launch.states import (
    STATES,
    TrialState,
    labels_of,
    progress_frame,
    states_of_experiment,
    summary_of,
)
from gsbench.runs.code import PERMISSIONS
from gsbench.runs.commands import PlannedTrial, drop, read_history
from gsbench.runs.experiments import experiment_home, list_experiments, trial_folders
from gsbench.runs.store import Stored, free, stored
from gsbench.runs.trial_folder import TrialFolder
from gsbench.runs.trial_record import FROM_RENDERS
from gsbench.system.locks import is_held
from gsbench.system.programs import allow_modules
from gsbench.verbs.arguments import options_of
from gsbench.words import counted, readable_bytes, readable_time

SECONDS_BETWEEN_LOOKS = 3.0
HOURS = {"h": 1, "d": 24, "w": 7 * 24}  # by the units of an age
SHOWN = ("folder", "state", "since", "note")  # facts of a trial in JSON

log = logging.getLogger(__name__)


def status(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 0 if all trials are done, running or queued, 1 if any failed or is missing."""
    options = options_of("status", argv)
    if options.experiment is None:
        if options.watch:
            raise InputError("--watch needs the name of an experiment")
        return _overview(runs)
    home = experiment_home(runs, options.experiment)
    if options.watch:
        _watch(runs, options.experiment)
    _say_what_is_lost(home)
    trials = states_of_experiment(home)
    if options.verify:
        for number, trial in enumerate(trials):
            is_done = trial.state in ("done", "superseded")
            if is_done and (fault := TrialFolder(trial.folder).fault_when_read()):
                trials[number] = replace(trial, state="damaged", note=str(fault))
    if options.forget_superseded:
        superseded = [trial for trial in trials if trial.state == "superseded"]
        remove(home, [trial.folder for trial in superseded])
        for trial in superseded:
            print(f"removed {trial.folder}: {trial.note}")
        print(f"{counted(len(superseded), 'superseded trial')} removed")
        return 0
    if options.forget:
        missing = [trial.folder for trial in trials if trial.state == "missing"]
        drop(home, missing)
        print(f"{counted(len(missing), 'trial')} removed from the plan")
        return 0
    if options.json:
        # without the plan's own entry; `default` is for the folder, a Path
        shown = [{key: vars(one)[key] for key in SHOWN} for one in trials]
        print(json.dumps(shown, indent=1, default=str))
    else:
        print("\n".join(lines_of(trials, options.all)))
    return int(any(STATES[trial.state].retried for trial in trials))


def _say_what_is_lost(home: Path) -> None:
    """Print a line for each fault of the plan: what it lists may be missing from the states."""
    for fault in read_history(home).faults:
        print(f"left out: {fault}", file=sys.stderr)


def _watch(runs: Path, experiment: str) -> None:
    """Show the progress of an experiment until its trials have ended, or Ctrl-C."""
    with suppress(KeyboardInterrupt), Live(auto_refresh=False) as live:
        while True:
            frame = progress_frame(runs, experiment)
            live.update(Text(f"{experiment}\n{frame.to_string()}\n", no_wrap=True), refresh=True)
            if not frame[["running", "waiting"]].to_numpy().any():
                break
            time.sleep(SECONDS_BETWEEN_LOOKS)


def lines_of(trials: list[TrialState], with_done: bool) -> list[str]:
    """A line for each trial not done or in doubt (``with_done``: for each), and a summary."""
    lines, labels = [], labels_of(trials)
    order = [*STATES]
    for trial in sorted(trials, key=lambda trial: order.index(trial.state)):
        if trial.state != "done" or trial.note or with_done:
            label = labels[trial.folder]
            lines.append(f"{trial.state:<8} {label:<50} {_age(trial):>12}  {trial.note}".rstrip())
    return [*lines, summary_of(trial.state for trial in trials)]


def _overview(runs: Path) -> int:
    names = list_experiments(runs)
    if not names:
        print(f"no experiment in {runs} yet")
    for name in names:
        _say_what_is_lost(runs / name)
        states = states_of_experiment(runs / name)
        print(f"{name:<20} {summary_of(trial.state for trial in states)}")
    return 0


def _age(trial: TrialState) -> str:
    """``for 5 min`` for a state that lasts, ``5 min ago`` for a final one."""
    if trial.since is None:
        return ""
    time_since = readable_time(max(0.0, time.time() - trial.since))
    return f"for {time_since}" if STATES[trial.state].lasts else f"{time_since} ago"


def retry(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: the exit code says whether a trial failed, as that of a sweep does."""
    from gsbench.app.command import run_trials

    options = options_of("retry", argv)
    home = experiment_home(runs, options.experiment)
    if refused := [change for change in options.changes if makes_other_trials(key_of(change))]:
        raise InputError(
            f"{refused[0]} would make other trials than those of the plan: give the sweep's own "
            "command"
        )
    _say_what_is_lost(home)
    unfinished = [trial for trial in states_of_experiment(home) if STATES[trial.state].retried]
    if not unfinished:
        print(f"nothing to retry: all trials of {options.experiment} are done, running or queued")
        return 0
    modules = os.getcwd()  # noted now, since `recompose` changes the current folder
    trials, replaced = list[Trial](), list[Path]()
    for old in unfinished:
        trials.append(recompose(old.folder, old.planned, runs, options.changes, modules))
        # A plan of somebody's must not declare or run anything in an experiment of the user's.
        if (other := trials[-1].files.home) != home:
            raise InputError(
                f"{TrialFolder(old.folder).label} is planned as a trial of {other.name}, not of "
                f"{home.name}: give the sweep's own command"
            )
        if trials[-1].folder != old.folder:
            replaced += [old.folder] if old.planned else []
            log.info(
                "%s: its configuration has changed since; the new one is run",
                TrialFolder(old.folder).label,
            )
    if options.dry_run:
        print("\n".join(describe_plan(trials, trials[0].values["launch"]["parallel"])))
        return 0
    code = run_trials(trials)
    drop(home, replaced)
    return code


def recompose(
    folder: Path, planned: PlannedTrial | None, runs: Path, changes: list[str], modules: str
) -> Trial:
    """The trial in ``folder``: from its planned overrides, else from its ``config.yaml``.

    Neither gives permission to run code: ``changes`` must give it again. ``modules`` is the folder
    of the user's modules.
    """
    if planned is not None:
        if Path(planned.cwd).is_dir():
            # relative paths were meant from there, and the trials are run from there
            os.chdir(planned.cwd)
        kept = [word for word in planned.words if key_of(word) != PERMISSIONS]
        # Modules are not taken from planned.cwd: somebody else's plan would name a folder of
        # theirs.
        trial = compose_one(changed_words(kept, changes), typed=changes, modules=modules)
        return Trial(trial.values | {"runs": str(runs)}, trial.overrides)
    files, allowed = TrialFolder(folder), typed_permissions(changes)
    if any(key_of(change) != PERMISSIONS for change in changes):
        raise InputError(
            f"{files.label} is in no plan, so no setting of it can be changed: run it by its own "
            "command"
        )
    allow_modules(allowed, modules)
    values = files.configuration() | {"runs": str(runs), PERMISSIONS: list(allowed)}
    if values["densify"].get("evaluated_from") == FROM_RENDERS:
        raise InputError(
            f"{files.label} was entered from renders: give the command of `gsbench evaluate` again"
        )
    return Trial(check(values), ())  # an earlier version had settings that are gone


def declare(argv: Sequence[str], runs: Path) -> int:
    """Run the verb; raises InputError for a wrong sweep."""
    options_of("declare", argv)
    from gsbench.app.command import compose_trials  # here, since it loads Hydra

    words, _, _ = parse(argv)  # the words of a command
    trials = compose_trials(words, multirun=True)
    if any(trial.values["launch"]["stop_when_decided"] for trial in trials):
        check_looks(trials, planned_rows(trials))
    check_questions(trials)
    make_runs_folder(trials[0].values["runs"])
    questions = record(trials)  # which says them
    print(
        f"{trials[0].values['name']}: {counted(len(trials), 'trial')} and "
        f"{counted(len(questions), 'question')}"
    )
    return 0


def clean(argv: Sequence[str], runs: Path) -> int:
    """Run the verb; what a finished trial needs always stays."""
    options = options_of("clean", argv)
    trials = [
        Path(place) for name in list_experiments(runs) for place in trial_folders(runs / name)
    ]
    let_go = set[Path]()
    if options.experiment is not None:
        states = states_of_experiment(experiment_home(runs, options.experiment))
        let_go = {trial.folder for trial in states if STATES[trial.state].freed}
    if running := [place for place in trials if is_held(TrialFolder(place).lock)]:
        raise InputError(
            f"{counted(len(running), 'trial')} of this runs folder run now, and may need what "
            "nothing refers to yet: wait for them"
        )
    found = stored(runs, [place for place in trials if place not in let_go])
    goes = [one for one in found if not one.needed and one.age >= options.older_than]
    print("\n".join(_store_lines(found, goes)))
    if options.dry_run:
        print(f"would free {_amount(goes)}; without --dry-run they are removed")
        return 0
    print(f"freed {_amount(free(runs, goes))}")
    return 0


def _store_lines(found: Sequence[Stored], goes: Sequence[Stored]) -> list[str]:
    """A line for each stage: its results, their bytes, and what nothing refers to."""
    lines = []
    for stage in sorted({one.stage for one in found}):
        own = [one for one in found if one.stage == stage]
        needed = sum(one.needed for one in own)
        free_now = sum(one.stage == stage for one in goes)
        size = readable_bytes(sum(one.size for one in own))
        lines.append(
            f"{stage:<14} {counted(len(own), 'result'):>12} {size:>10}   {needed} needed by "
            f"trials, {len(own) - needed - free_now} kept for their age, {free_now} to free"
        )
    return lines or ["the store is empty"]


def _amount(places: Sequence[Stored]) -> str:
    return f"{counted(len(places), 'result')}, {readable_bytes(sum(one.own for one in places))}"


def age(text: str) -> float:
    """The seconds of an age such as ``30d``."""
    match = re.fullmatch(r"(\d{1,6})([hdw])", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"must be an age such as 12h, 30d or 4w, got {text!r}")
    return int(match[1]) * 3600.0 * HOURS[match[2]]
