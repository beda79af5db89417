"""Writing down what a command declares before its trials run. Loads no torch."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

from gsbench.config.compose import Trial
from gsbench.errors import InputError
from gsbench.files import write_text
from gsbench.runs.declaration import (
    Declaration,
    Planned,
    declared_now,
    open_question,
    read_declarations,
    record_text,
    trial_key,
    united,
)
from gsbench.runs.experiments import make_home
from gsbench.runs.layout import DECLARED, SEED
from gsbench.system.locks import hold

log = logging.getLogger(__name__)


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


def planned_trials(trials: Sequence[Trial]) -> dict[Path, Planned]:
    """The trials that a command asks for, by the folder of their experiment, whether they are done or not."""
    found: dict[Path, dict[str, set[int]]] = {}
    for trial in trials:
        scene, arm, leaf = trial.folder.parts[-3:]
        key = trial_key(scene, arm, leaf.partition(SEED)[0])
        found.setdefault(trial.files.home, {}).setdefault(key, set()).add(trial.values["seed"])
    return {home: {key: tuple(sorted(seeds)) for key, seeds in planned.items()} for home, planned in found.items()}


def declare(metrics: Mapping[Path, str | None], planned: Mapping[Path, Planned]) -> None:
    """Add to each experiment's record what its trials declare, where it does not stand there yet.

    That is a metric (`declared_metrics`) and the trials that a command asks for (`planned_trials`). A declaration is
    not taken back by a command without one: the trials that such a command adds are added to it, with their time.
    """
    for home, given in metrics.items():
        make_home(home)
        with hold(home / f".{DECLARED}.lock", "the declarations"):
            every = read_declarations(home)
            known = [one for one in every if not one.of_claims]
            latest = known[-1] if known else None
            metric = latest.primary if given is None and latest is not None else given
            if metric is None:
                continue
            if given is None and latest is not None:
                log.info("%s: %s stays declared, since %s", home.name, latest.primary, latest.when)
            before = {} if latest is None else latest.planned
            together = united(before, planned[home])
            same = latest is not None and latest.primary == metric
            known_trials = latest is not None and latest.names_trials
            if same and (together == before or not known_trials):
                continue
            added = declared_now(questions=(open_question(metric),), trials=dict(together))
            _write(home, [*every, added])
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
        _write(home, [*every, asked])
    if known:
        log.warning(
            "%s: other questions were declared before: trials that were measured under them count as looked at",
            home.name,
        )
    return asked


def _write(home: Path, declarations: Sequence[Declaration]) -> None:
    """The whole record."""
    write_text(home / DECLARED, record_text(declarations))
