"""Verbs about trials of an experiment: ``gsbench status``, ``retry``, ``declare`` and ``sync``."""

from __future__ import annotations

import json
import logging
import os
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
from gsbench.errors import GsbenchError, InputError
from gsbench.files import checked_runs_folder, make_runs_folder
from gsbench.launch.estimates import SPEED, describe_plan, progress_frame
from gsbench.launch.record import check_looks, check_questions, planned_rows, record, remove
from gsbench.launch.states import (
    STATES,
    TrialState,
    labels_of,
    states_of_experiment,
    summary_of,
)
from gsbench.runs.commands import PlannedTrial, drop, read_history
from gsbench.runs.experiments import experiment_home, list_experiments, trial_folders
from gsbench.runs.trial_folder import TrialFolder
from gsbench.runs.trial_record import FROM_RENDERS
from gsbench.runs.user_code import PERMISSIONS
from gsbench.system.programs import allow_modules
from gsbench.tracking.beside import send_beside
from gsbench.tracking.sync import MirrorError
from gsbench.tracking.sync import sync as send_missing
from gsbench.verbs.arguments import ArgumentParser, Rows
from gsbench.words import counted, readable_time

SECONDS_BETWEEN_LOOKS = 3.0
SHOWN = ("folder", "state", "since", "note")  # facts of a trial in JSON

log = logging.getLogger(__name__)


def status(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 0 if all trials are done, running or queued, 1 if any failed or is missing."""
    rows: Rows = {
        "experiment?": "its name; without one, a line for each experiment",
        "--all": "list the finished trials too",
        "--watch": "a row for each arm, renewed until all trials have ended",
        "--verify": "also compare by content what a look leaves to size and time: large files, and "
        "the results of stages in the store",
        "--json": "print a JSON list instead of lines",
        "--forget": "remove trials from the plan that never started",
        "--forget-superseded": "delete the folders of trials that older code made; what their "
        "stages computed stays in the store, and verdicts still count them as versions of the code",
    }
    options = ArgumentParser("status", rows=rows).parse_args(argv)
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
            if trial.state in ("done", "superseded"):
                fault = TrialFolder(trial.folder).fault_when_read()
                if fault is not None:
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
            shown = frame.rename(columns={SPEED: "it/s"}).to_string(float_format="{:.3g}".format)
            left = frame.attrs["seconds_left"]
            after = f"about {readable_time(left)} left\n" if left else ""
            live.update(Text(f"{experiment}\n{shown}\n{after}", no_wrap=True), refresh=True)
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

    rows: Rows = {
        "experiment": "its name",
        "changes* KEY=VALUE": "settings that do not make a different trial: launch=slurm …; "
        "allow_targets=[mine] for your own code",
        "--dry-run": "only list them",
    }
    options = ArgumentParser("retry", rows=rows).parse_args(argv)
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
    return Trial(values, ())


def declare(argv: Sequence[str], runs: Path) -> int:
    """Run the verb; raises InputError for a wrong sweep."""
    parser = ArgumentParser(
        "declare",
        "It writes the questions of a sweep and trains nothing: for loops and arrays of jobs that "
        "train its trials one by one. Each of these commands then asks nothing more.",
        {"settings* KEY=VALUE": "as of a sweep", "--config-dir FOLDER": "as of a sweep"},
    )
    parser.add_argument("-m", "--multirun", action="store_true", help="is understood")
    parser.parse_args(argv)
    from gsbench.app.command import compose_trials  # here, since it loads Hydra

    words, _, _ = parse(argv)  # the words of a command
    trials = compose_trials(words, multirun=True)
    if any(trial.values["launch"]["stop_when_decided"] for trial in trials):
        check_looks(trials, planned_rows(trials))
    check_questions(trials)
    make_runs_folder(checked_runs_folder(trials[0].values["runs"]))
    questions = record(trials)  # which says them
    print(
        f"{trials[0].values['name']}: {counted(len(trials), 'trial')} and "
        f"{counted(len(questions), 'question')}"
    )
    return 0


def sync(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 1 if the tracker cannot be reached."""
    rows: Rows = {
        "experiment?": "its name; without one, all",
        "permissions* allow_targets=[mine]": "for trials that a tracker of your own shows",
        "--uri ADDRESS": "such as http://127.0.0.1:5000; default: $MLFLOW_TRACKING_URI, or the "
        "runs folder's",
        "--beside SECONDS": ("send the trials that the standard input names, to its end", float),
    }
    options = ArgumentParser("sync", rows=rows).parse_args(argv)
    words = [options.experiment or "", *options.permissions]
    experiment = "" if "=" in words[0] else words.pop(0)
    if unread := [word for word in words if key_of(word) != PERMISSIONS]:
        raise InputError(f"sync reads only {PERMISSIONS}, not {unread[0]}")
    allow_modules(allowed := typed_permissions(words))
    names = [experiment] if experiment else list_experiments(runs)
    homes = [experiment_home(runs, name) for name in names]
    try:
        if options.beside is not None:
            send_beside(sys.stdin, options.beside)
            return 0
        places = [place for home in homes for place in sorted(trial_folders(home))]
        folders = [TrialFolder(Path(place)) for place in places]
        for line in send_missing(folders, options.uri, allowed):
            print(line, flush=True)
    except (MirrorError, OSError) as error:
        raise GsbenchError(f"{error}; the files are complete: try again") from error
    return 0
