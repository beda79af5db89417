"""``gsbench clean``: what the store holds, and removing what no trial refers to."""

import re
from argparse import ArgumentTypeError
from collections.abc import Sequence
from pathlib import Path

from gsbench.errors import InputError
from gsbench.launch.states import STATES, states_of_experiment
from gsbench.runs.cleaning import Stored, free, stored
from gsbench.runs.experiments import experiment_home, list_experiments, trial_folders
from gsbench.runs.trial_folder import TrialFolder
from gsbench.system.locks import is_held
from gsbench.verbs.arguments import ArgumentParser, Rows
from gsbench.words import counted, readable_bytes

UNITS = {"h": 3600.0, "d": 86_400.0, "w": 7 * 86_400.0}


def clean(argv: Sequence[str], runs: Path) -> int:
    """Run the verb; what a finished trial needs always stays."""
    rows: Rows = {
        "experiment?": (
            "also free what only its failed, stopped and superseded trials have in the store"
        ),
        "--older-than AGE": (
            "such as 12h, 30d or 0d; younger results stay, since a stopped sweep continues from "
            "them (30d)",
            _age,
            "30d",
        ),
        "--dry-run": "only show what would be freed",
    }
    options = ArgumentParser("clean", rows=rows).parse_args(argv)
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
    print("\n".join(_lines(found, goes)))
    if options.dry_run:
        print(f"would free {_amount(goes)}; without --dry-run they are removed")
        return 0
    print(f"freed {_amount(free(runs, goes))}")
    return 0


def _lines(found: Sequence[Stored], goes: Sequence[Stored]) -> list[str]:
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


def _age(text: str) -> float:
    """The seconds of an age such as ``30d``."""
    match = re.fullmatch(r"(\d{1,6})([hdw])", text)
    if match is None:
        raise ArgumentTypeError(f"must be an age such as 12h, 30d or 4w, got {text!r}")
    return int(match[1]) * UNITS[match[2]]
