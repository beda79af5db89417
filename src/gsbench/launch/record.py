"""Records of a command, written before its trials run: the plan, and what is declared. Loads no torch.

``<runs>/<experiment>/plan.json`` maps the folder of every trial that was ever asked for to the overrides that describe
it, so that what is missing can be named; ``declared.jsonl`` is `gsbench.runs.declaration`'s.
"""

import logging
import os
import shutil
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator

from gsbench.config.compose import Trial
from gsbench.errors import InputError
from gsbench.files import require_no_links, write_json, write_text
from gsbench.parsing import DamagedError
from gsbench.records import Amount, Record, read_typed
from gsbench.runs.declaration import (
    Declaration,
    declared_now,
    merge_planned,
    open_question,
    read_declarations,
    record_text,
)
from gsbench.runs.experiments import make_home
from gsbench.runs.layout import DECLARED, PLAN, RESULTS
from gsbench.settings import is_folder_name
from gsbench.system.locks import hold

log = logging.getLogger(__name__)

PLAN_VERSION = 1
LEVELS = 3  # scene, arm, trial


@dataclass(frozen=True, kw_only=True)
class PlannedTrial(Record):
    """A trial of the plan: its overrides, where the command was given, and when (Unix time)."""

    overrides: tuple[str, ...]
    cwd: str
    time: Amount


def _is_below(name: str) -> str:
    parts = name.split("/")
    if len(parts) != LEVELS or not all(map(is_folder_name, parts)):
        raise ValueError("it is not a folder of a trial")
    return name


@dataclass(frozen=True, kw_only=True)
class PlanFile(Record):
    """The whole file; ``trials`` are by their folders as seen from the experiment's."""

    version: int
    trials: dict[Annotated[str, AfterValidator(_is_below)], PlannedTrial]


def add_to_plan(trials: Sequence[Trial]) -> None:
    """Write the trials into the plans of their experiments; those that were there stay.

    A trial that was read from its own record stays out: its plan would hold no words, which describe the defaults.
    """
    by_home: dict[Path, dict[Path, PlannedTrial]] = {}
    for trial in trials:
        if trial.overrides:
            planned = PlannedTrial(overrides=tuple(trial.overrides), cwd=os.getcwd(), time=time.time())
            by_home.setdefault(trial.files.home, {})[trial.folder] = planned
    for home, added in by_home.items():
        make_home(home)
        with hold(home / f".{PLAN}.lock", "the plan"):
            _write_plan(home, read_plan(home) | added)


def forget(home: Path, folders: Iterable[Path]) -> None:
    """Drop trials from the plan of the experiment in ``home``."""
    doomed = set(folders)
    with hold(home / f".{PLAN}.lock", "the plan"):
        _write_plan(home, {folder: trial for folder, trial in read_plan(home).items() if folder not in doomed})


def remove(home: Path, folders: Iterable[Path]) -> None:
    """Delete the folders of trials and drop them from the plan of the experiment in ``home``.

    What the stages computed stays in the store: where the old code comes back, its trials are only put together again.
    """
    folders = list(folders)
    for folder in folders:
        require_no_links(home.parent, folder)
        (folder / RESULTS).unlink(missing_ok=True)  # first, so that no part of a trial is ever taken for all of it
        shutil.rmtree(folder)
    forget(home, folders)


def read_plan(home: Path) -> dict[Path, PlannedTrial]:
    """The planned trials of the experiment in ``home`` by their folders; none if it has no plan.

    None either where it is damaged, which is said: trials of other commands are found by their folders, if they have
    begun.
    """
    try:
        trials = read_typed(home / PLAN, PlanFile).trials
    except FileNotFoundError:
        return {}
    except DamagedError as error:
        log.warning("left out: %s: to write it again, run the sweep's command", error)
        return {}
    return {home / name: trial for name, trial in sorted(trials.items())}


def _write_plan(home: Path, trials: dict[Path, PlannedTrial]) -> None:
    names = {folder.relative_to(home).as_posix(): trial for folder, trial in trials.items()}
    write_json(home / PLAN, PlanFile(version=PLAN_VERSION, trials=names).to_json())


# ---- what is declared


def declared_metrics(trials: Sequence[Trial]) -> dict[Path, str | None]:
    """The metric that each experiment's trials declare (``eval.primary``), by its folder; None where none does.

    Raises InputError where trials of one experiment declare different ones.
    """
    found: dict[Path, str | None] = {}
    for trial in trials:
        home = trial.files.home
        metric, known = trial.values["eval"].get("primary"), found.get(home)
        if metric and known and metric != known:
            raise InputError(
                f"trials of {home.name} declare eval.primary={known} and eval.primary={metric}: a verdict is about one "
                "metric, so give one of them, or run two experiments (name=…)"
            )
        found[home] = known or metric
    return found


def declare(trials: Sequence[Trial]) -> None:
    """Add to each experiment's record what these trials declare, where it does not stand there yet.

    That is a metric (`declared_metrics`) and the trials themselves, whether they are done or not. A declaration is not
    taken back by a command without one: the trials that such a command adds are added to it, with their time.
    """
    for home, given in declared_metrics(trials).items():
        seeds: dict[str, set[int]] = {}
        for trial in trials:
            if trial.files.home == home:
                seeds.setdefault(trial.files.key, set()).add(trial.values["seed"])
        asked = {key: tuple(sorted(own)) for key, own in seeds.items()}
        make_home(home)
        with hold(home / f".{DECLARED}.lock", "the declarations"):
            every = read_declarations(home)
            latest = next((one for one in reversed(every) if not one.of_claims), None)
            metric = given or (None if latest is None else latest.primary)
            if metric is None:
                continue
            if latest is not None and given is None:
                log.info("%s: %s stays declared, since %s", home.name, latest.primary, latest.when)
            before = {} if latest is None else latest.planned
            together = merge_planned(before, asked)
            same = latest is not None and latest.primary == metric
            if latest is not None and same and (together == before or not latest.names_trials):
                continue
            added = declared_now(questions=(open_question(metric),), trials=dict(together))
            write_text(home / DECLARED, record_text([*every, added]))
        if same:
            log.warning(
                "%s: trials are added to those declared with %s; if there are results already, it no longer decides "
                "the verdict alone",
                home.name,
                metric,
            )
        elif latest is not None:
            log.warning(
                "%s: the verdict is from now on about %s, and the report will say that %s was declared before",
                home.name,
                metric,
                latest.primary,
            )


def declare_questions(home: Path, asked: Declaration) -> Declaration:
    """Add questions that name their trials (a file of claims, a sweep in looks) to the record; the one that stands.

    One that is the latest of its kind there already stands with its time.
    """
    if not asked.questions:
        return asked
    make_home(home)
    with hold(home / f".{DECLARED}.lock", "the declarations"):
        every = read_declarations(home)
        known = [one for one in every if one.of_claims == asked.of_claims]
        if known and known[-1].hash == asked.hash:
            return known[-1]
        write_text(home / DECLARED, record_text([*every, asked]))
    if known:
        log.warning(
            "%s: other questions were declared before: trials that were measured under them count as looked at",
            home.name,
        )
    return asked
