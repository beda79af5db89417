"""The plan of an experiment: every trial that was ever asked for under its name, so that what is missing can be named.

``<runs>/<experiment>/plan.json`` maps a trial's folder to the overrides that describe it. Loads no torch.
"""

from __future__ import annotations

import logging
import os
import shutil
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from gsbench.config.compose import Trial
from gsbench.errors import GsbenchError, InputError
from gsbench.files import require_own
from gsbench.launch.experience import Experience
from gsbench.launch.queue import ask_queue, state_in_queue
from gsbench.runs.experiments import make_home
from gsbench.runs.layout import PLAN, RESULTS, STORE
from gsbench.runs.plan_file import Entry, read_entries, write_entries
from gsbench.system.locks import hold
from gsbench.words import counted, readable_time

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Planned:
    """A trial of the plan: its folder, its overrides, where the command was given, and when (Unix time)."""

    folder: Path
    overrides: tuple[str, ...]
    cwd: str
    time: float


def add_to_plan(trials: Sequence[Trial]) -> None:
    """Write the trials into the plans of their experiments; those that were there stay.

    A trial that was read from its own record stays out: its plan would hold no words, which describe the defaults.
    """
    by_plan: dict[Path, dict[str, Entry]] = {}
    for trial in trials:
        if trial.recorded:
            continue
        folder = trial.files
        entry = Entry(overrides=tuple(trial.overrides), cwd=os.getcwd(), time=time.time())
        by_plan.setdefault(folder.home, {})[folder.path.relative_to(folder.home).as_posix()] = entry
    for home, entries in by_plan.items():
        make_home(home)
        with hold(home / f".{PLAN}.lock", "the plan"):
            try:
                known = read_entries(home)
            except InputError as error:  # trials of other commands are found by their folders, if they have begun
                log.warning("%s", error)
                known = {}
            write_entries(home, known | entries)


def forget(home: Path, folders: Iterable[Path]) -> None:
    """Drop trials from the plan of the experiment in ``home``."""
    doomed = {folder.relative_to(home).as_posix() for folder in folders}
    with hold(home / f".{PLAN}.lock", "the plan"):
        write_entries(home, {name: entry for name, entry in read_entries(home).items() if name not in doomed})


def remove(home: Path, folders: Iterable[Path]) -> None:
    """Delete the folders of trials and drop them from the plan of the experiment in ``home``.

    What the stages computed stays in the store: where the old code comes back, its trials are only put together again.
    """
    folders = list(folders)
    for folder in folders:
        require_own(home.parent, folder)
        (folder / RESULTS).unlink(missing_ok=True)  # first, so that no part of a trial is ever taken for all of it
        shutil.rmtree(folder)
    forget(home, folders)


def read_plan(home: Path) -> list[Planned]:
    """The planned trials of the experiment in ``home``; none if it has no plan, or a damaged one, which is named."""
    try:
        entries = read_entries(home)
    except InputError as error:
        log.warning("left out: %s", error)
        entries = {}
    return [Planned(home / name, entry.overrides, entry.cwd, entry.time) for name, entry in sorted(entries.items())]


def _stage_finder(trials: Sequence[Trial]) -> Callable[[Trial], list[str]]:
    """A function that tells which stages of a trial are in the store; loads torch only where there is such a store."""
    store = trials[0].files.runs / STORE if trials else None
    if store is None or not store.is_dir():
        return lambda trial: []
    from gsbench.pipeline.parts import Parts
    from gsbench.pipeline.wiring import StepFinder
    from gsbench.runs.store import Store

    finder = StepFinder(Store(store))

    def built(trial: Trial) -> list[str]:
        try:
            return finder.built_stages(Parts(trial.values))
        except GsbenchError:  # what is missing here is named elsewhere, or known where the trial will run
            return []

    return built


def describe_plan(trials: Sequence[Trial], parallel: int = 1) -> list[str]:
    """Lines for ``--dry-run``: each trial with its state, and the time that the unfinished ones will take."""
    lines, remaining, unknown, counts = (
        [],
        0.0,
        0,
        dict.fromkeys(("done", "partial", "missing", "running", "queued", "failed", "damaged"), 0),
    )
    experience = Experience(trials[0].files.runs) if trials else None
    learned = 0
    built_stages = _stage_finder(trials)
    queue = ask_queue(trial.folder for trial in trials)
    for trial in trials:
        folder = trial.files
        state: str = folder.state()
        if state not in ("done", "running"):
            state = state_in_queue(folder.path, queue) or state
        note = ""
        if state == "done":
            if reason := folder.why_not_done(trial.values):
                note = f"  will be checked: {reason}"
        else:
            assert experience is not None
            shared = experience.elsewhere(folder)
            if shared is not None:
                note = f"  as in {shared}: nothing to compute"
            else:
                estimate = experience.estimate(trial.values)
                done = folder.stage_and_step()[1] / max(1, trial.values["train"]["iterations"])
                remaining += estimate.seconds * (1 - min(1.0, done))
                learned = max(learned, estimate.learned_from)
                if built := built_stages(trial):
                    note = f"  the store has its {', '.join(built)}"
                unknown += estimate.learned_from == 0
        counts[state] += 1
        lines.append(f"{state:<8} {folder.label}{note}")
    summary = ", ".join(f"{count} {state}" for state, count in counts.items() if count)
    lines.append(f"{counted(len(trials), 'trial')}: {summary}")
    if counts["done"] < len(trials):
        if unknown:
            lines.append("time: not known, since no finished trial tells how long one takes here")
        elif learned == 0:
            lines.append("time: seconds, since other experiments have the results")
        else:
            at_once = f", {parallel} at once" if parallel > 1 else ""
            took = readable_time(remaining / parallel)
            lines.append(f"time: about {took}{at_once}, judged by {counted(learned, 'finished trial')}")
    return lines
