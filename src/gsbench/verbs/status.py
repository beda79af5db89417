"""``gsbench status``: the trials of an experiment that are done, running, failed or missing."""

import json
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from gsbench.analysis.differences import find_superseded
from gsbench.analysis.results import TrialResult, read_experiment
from gsbench.launch.record import forget, read_plan, remove
from gsbench.launch.states import TrialState, states_of_experiment
from gsbench.runs.code import module_digest
from gsbench.runs.experiments import experiment_home, list_experiments
from gsbench.verbs.arguments import ArgumentParser
from gsbench.words import counted, readable_time

ORDER = ("failed", "damaged", "running", "queued", "partial", "missing", "superseded", "done")


def main(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 0 if all trials are done, running or queued, 1 if some failed or are missing."""
    parser = ArgumentParser(prog="gsbench status", description="The state of every trial of an experiment.")
    parser.add_argument("experiment", nargs="?", help="its name; without one, a line for each experiment")
    parser.add_argument("--all", action="store_true", help="list the finished trials too")
    parser.add_argument("--json", action="store_true", help="print a JSON list instead of lines")
    parser.add_argument("--forget", action="store_true", help="remove trials from the plan that never started")
    parser.add_argument(
        "--forget-superseded",
        action="store_true",
        help="delete the folders of trials that older code made; what their stages computed stays in the store",
    )
    options = parser.parse_args(argv)
    if options.experiment is None:
        return _overview(runs)
    home = experiment_home(runs, options.experiment)
    trials = progress_with_superseded(home)
    if options.forget_superseded:
        superseded = [trial for trial in trials if trial.state == "superseded"]
        remove(home, [trial.folder for trial in superseded])
        for trial in superseded:
            print(f"removed {trial.folder}: {trial.note}")
        print(f"{counted(len(superseded), 'superseded trial')} removed")
        return 0
    if options.forget:
        missing = [trial.folder for trial in trials if trial.state == "missing"]
        forget(home, missing)
        print(f"{counted(len(missing), 'trial')} removed from the plan")
        return 0
    if options.json:
        print(json.dumps([_as_dict(trial) for trial in trials], indent=1))
    else:
        print("\n".join(lines_of(trials, options.all)))
    return 0 if all(trial.state in ("done", "running", "queued", "superseded") for trial in trials) else 1


def progress_with_superseded(home: Path) -> list[TrialState]:
    """The state of every trial of the experiment in ``home``, with ``superseded`` for those that older code made."""
    folders = {folder: trial.cwd for folder, trial in read_plan(home).items()}

    # The user's modules are read in the folder where the trial's command was given: another may have a namesake.
    def present_digest(module: str, trial: TrialResult) -> str | None:
        return module_digest(module, folders[trial.path]) if trial.path in folders else None

    reasons = find_superseded(read_experiment(home).trials, present_digest)
    return [
        replace(trial, state="superseded", note=reasons[trial.folder])
        if trial.state == "done" and trial.folder in reasons
        else trial
        for trial in states_of_experiment(home)
    ]


def lines_of(trials: list[TrialState], with_done: bool) -> list[str]:
    """A line for each trial that is not done (or for each, ``with_done``), and a summary."""
    lines = []
    for state in ORDER:
        if state == "done" and not with_done:
            continue
        for trial in trials:
            if trial.state == state:
                lines.append(f"{state:<8} {trial.label:<50} {_age(trial):>12}  {trial.note}".rstrip())
    lines.append(summary_of(trials))
    return lines


def summary_of(trials: list[TrialState]) -> str:
    """The number of trials in each state, in one line."""
    counts = {state: sum(trial.state == state for trial in trials) for state in reversed(ORDER)}
    return f"{counted(len(trials), 'trial')}: " + ", ".join(
        f"{count} {state}" for state, count in counts.items() if count
    )


def _overview(runs: Path) -> int:
    names = list_experiments(runs)
    if not names:
        print(f"no experiment in {runs} yet")
    for name in names:
        print(f"{name:<20} {summary_of(progress_with_superseded(runs / name))}")
    return 0


def _age(trial: TrialState) -> str:
    """``for 5 min`` for a state that lasts, ``5 min ago`` for a final one."""
    if trial.since is None:
        return ""
    time_since = readable_time(max(0.0, time.time() - trial.since))
    return f"for {time_since}" if trial.state in ("running", "queued") else f"{time_since} ago"


def _as_dict(trial: TrialState) -> dict[str, object]:
    return {"folder": str(trial.folder), "state": trial.state, "since": trial.since, "note": trial.note}
