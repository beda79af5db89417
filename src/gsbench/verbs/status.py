"""``gsbench status``: what an experiment has done, runs, failed and misses."""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

from gsbench.errors import InputError
from gsbench.launch.plan import Progress, forget, progress_of_experiment
from gsbench.pipeline.trial_files import label_of
from gsbench.words import counted, readable_time

ORDER = ("failed", "running", "partial", "missing", "done")


def main(argv: list[str]) -> int:
    """The verb: 0 if all trials are done, 1 if some failed or are missing."""
    from gsbench.cli import runs_dir

    parser = argparse.ArgumentParser(prog="gsbench status", description="The state of every trial of an experiment.")
    parser.add_argument("experiment", nargs="?", help="its name; without one, a line for each experiment")
    parser.add_argument("--all", action="store_true", help="list the finished trials too")
    parser.add_argument("--json", action="store_true", help="a list of objects instead of lines")
    parser.add_argument("--forget", action="store_true", help="take trials that were never started out of the plan")
    options = parser.parse_args(argv)
    if options.experiment is None:
        return _overview(runs_dir())
    home = experiment_home(runs_dir(), options.experiment)
    trials = progress_of_experiment(home)
    if options.forget:
        missing = [trial.folder for trial in trials if trial.state == "missing"]
        forget(home, missing)
        print(f"{counted(len(missing), 'trial')} taken out of the plan")
        return 0
    if options.json:
        print(json.dumps([_as_dict(trial) for trial in trials], indent=1))
    else:
        print("\n".join(lines_of(trials, options.all)))
    return 0 if all(trial.state in ("done", "running") for trial in trials) else 1


def experiment_home(runs: Path, name: str) -> Path:
    """The folder of the experiment ``name``; raises InputError naming those there are."""
    from gsbench.analysis.results import list_experiments

    if name not in list_experiments(runs):
        raise InputError(f"no experiment {name!r} in {runs}; there: {', '.join(list_experiments(runs)) or 'none yet'}")
    return runs / name


def lines_of(trials: list[Progress], everything: bool) -> list[str]:
    """A line for each trial that deserves attention (or each, with ``everything``), and a summary."""
    lines = []
    for state in ORDER:
        if state == "done" and not everything:
            continue
        for trial in trials:
            if trial.state == state:
                lines.append(f"{state:<8} {label_of(trial.folder):<50} {_age(trial):>10}  {trial.note}".rstrip())
    lines.append(summary_of(trials))
    return lines


def summary_of(trials: list[Progress]) -> str:
    """How many trials are in which state, in one line."""
    counts = {state: sum(trial.state == state for trial in trials) for state in reversed(ORDER)}
    return f"{counted(len(trials), 'trial')}: " + ", ".join(
        f"{count} {state}" for state, count in counts.items() if count
    )


def _overview(runs: Path) -> int:
    from gsbench.analysis.results import list_experiments

    names = list_experiments(runs)
    if not names:
        print(f"no experiment in {runs} yet")
    for name in names:
        print(f"{name:<20} {summary_of(progress_of_experiment(runs / name))}")
    return 0


def _age(trial: Progress) -> str:
    return "" if trial.since is None else readable_time(max(0.0, time.time() - trial.since))


def _as_dict(trial: Progress) -> dict[str, object]:
    return {"folder": str(trial.folder), "state": trial.state, "since": trial.since, "note": trial.note}
