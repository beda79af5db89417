"""Writing a command and its questions down, before its trials run (`gsbench.runs.commands`).

Loads no torch.
"""

import logging
import shutil
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from gsbench.analysis.cells import with_variants
from gsbench.analysis.quantities import COSTS, TEXTURED, askable_names
from gsbench.analysis.questions import (
    FIRST_LOOK,
    Asked,
    Named,
    NamedQuestion,
    announce,
    ask,
    plan_looks,
    read_least,
)
from gsbench.analysis.results import group_by, read_experiment
from gsbench.analysis.trial_result import Planned
from gsbench.config.build import facts_for
from gsbench.config.compose import Trial
from gsbench.errors import InputError
from gsbench.files import require_no_links
from gsbench.runs.commands import (
    Command,
    History,
    PlannedTrial,
    Question,
    append,
    command_now,
    digest_of,
    drop,
    read_history,
)
from gsbench.runs.configuration import flatten
from gsbench.runs.experiments import DEFAULT_METRIC, QUESTIONS, metric_and_question
from gsbench.runs.layout import ASKED, RESULTS, SEED, TUNING
from gsbench.settings import check_values
from gsbench.words import did_you_mean

log = logging.getLogger(__name__)

DIRECTIONS = {"higher": 1, "lower": -1, "same": 0}


def record(trials: Sequence[Trial], asks: bool = True) -> list[Question]:
    """Write the trials of a command down, each in its experiment; returns their questions.

    With ``asks``, the questions that no earlier command asked are written, too. A trial that is
    read from its own record has no words and asks nothing. A repeated command adds no line.
    Raises InputError if trials of one experiment name different metrics.
    """
    asked_metrics(trials)
    typed = group_by([one for one in trials if one.overrides], "files.home")
    return [question for home, own in typed.items() for question in _record(home, own, asks)]


def _record(home: Path, trials: Sequence[Trial], asks: bool) -> list[Question]:
    rows = planned_rows(trials)
    asked = None
    if asks and not (home / TUNING).exists() and read_history(home).ledger is None:
        asked = asked_of(trials, rows)
    measured = read_experiment(home).trials if asked and home.is_dir() else ()
    asked_now: list[Question] = []

    def make(history: History) -> Command | None:
        found, shown = ask(rows, asked, measured, history) if asked else ([], [])
        asked_now.extend([*found, *(one for one in history.questions if one.id in shown)])
        if set(shown) <= history.last:
            shown = []  # they are the newest ones already
        planned = {
            trial.folder.relative_to(home).as_posix(): PlannedTrial(
                words=tuple(trial.overrides), digest=row.digest
            )
            for trial, row in zip(trials, rows, strict=True)
        }
        known = history.planned
        is_new = any(
            (before := known.get(home / name)) is None or before.digest != trial.digest
            for name, trial in planned.items()
        )
        if not (found or shown or is_new):
            return None
        return command_now(trials=planned, questions=tuple(found), shows=tuple(shown))

    line = append(home, make)
    for question in () if line is None else line.questions:
        log.info("%s: %s", home.name, announce(question))
    return asked_now


def asked_metrics(trials: Sequence[Trial]) -> dict[Path, str]:
    """The metric of the verdict (``eval.primary``) by the experiment's folder.

    Raises InputError if trials of one experiment name different ones.
    """
    metrics: dict[Path, str] = {}
    for trial in trials:
        home, metric = trial.files.home, trial.values["eval"].get("primary") or DEFAULT_METRIC
        if metrics.setdefault(home, metric) != metric:
            raise InputError(
                f"trials of {home.name} name eval.primary={metrics[home]} and "
                f"eval.primary={metric}: a verdict is about one metric, so give one of them, or "
                "run two experiments (name=…)"
            )
    return metrics


def planned_rows(trials: Sequence[Trial]) -> list[Planned]:
    """The trials, each with its variant, as far as questions depend on them."""
    configs: dict[Path, tuple[str, Mapping[str, Any]]] = {}
    rows = []
    for trial in trials:
        values = trial.values
        key = trial.folder.parent / trial.folder.name.partition(SEED)[0]
        if key not in configs:  # all seeds share it
            configs[key] = digest_of(values), flatten(values)
        digest, config = configs[key]
        scene, init, densify = (values[group]["name"] for group in ("scene", "init", "densify"))
        rows.append(Planned(scene, init, densify, key.name, values["seed"], config, digest))
    return with_variants(rows)


def asked_of(trials: Sequence[Trial], rows: Sequence[Planned]) -> Asked | None:
    """The questions of one experiment's trials; None if their metric has no direction."""
    values = trials[0].values
    options, launch = values["eval"], values["launch"]
    metric, about = metric_and_question(options.get("primary") or DEFAULT_METRIC)
    facts = facts_for(metric, values)
    if not facts.direction:
        log.warning("whether more of %s is better is not known: nothing is tested", metric)
        return None
    named = _named(values, metric, rows, trials[0].files.home)
    split = next((key for key, question in QUESTIONS.items() if question == about), "")
    return Asked(
        metric=metric,
        sign=facts.direction,
        least=launch.get("least_difference") or facts.worthwhile,
        baseline=options.get("baseline") or "adc",
        controls=options.get("controls") or {},
        looks=(
            plan_looks(len({row.seed for row in rows})) if launch.get("stop_when_decided") else ()
        ),
        split=split,
        shared=values.get("error_rate") == "shared",
        named=named,
    )


def check_questions(trials: Sequence[Trial]) -> None:
    """Raise InputError for a wrong question that an experiment's file names."""
    asked_metrics(trials)
    for own in group_by(trials, "files.home").values():
        asked_of(own, planned_rows(own))


def _named(
    values: Mapping[str, Any], metric: str, rows: Sequence[Planned], home: Path
) -> tuple[Named, ...] | None:
    """The questions that the experiment's file names, if any; raises InputError for a wrong one.

    A command that trains a part of the sweep may lack the arms of a question that an earlier
    command of the experiment in ``home`` asked: it leaves that question out.
    """
    if not values.get("questions"):
        return None
    earlier, found = {question.name for question in read_history(home).questions}, []
    for number, entry in enumerate(values["questions"], 1):
        where = f"questions[{number}]"
        if not isinstance(entry, dict) or "idea" not in entry:
            raise InputError(f"{where} must be a mapping with idea, baseline, metric, …")
        named = NamedQuestion(**check_values(NamedQuestion, entry, where))
        asked = named.metric or metric
        known = (*askable_names(), *(values["eval"].get("extra") or {}))
        if asked not in known:
            raise InputError(f"{where}.metric={asked} is no metric{did_you_mean(asked, known)}")
        name, sides = f"{named.idea}-{number}", (named.idea, named.baseline)
        if name in earlier and not all(named.fitting(word, rows) for word in sides):
            continue
        for word in sides:
            named.rows(word, rows)  # raises unless it is one arm
        facts = None if asked in (*COSTS, TEXTURED.key) else facts_for(asked, values)
        sign = DIRECTIONS.get(named.direction, facts.direction if facts else -1)
        usual = facts.worthwhile if facts else None
        least = usual if named.least is None else named.least
        is_cost = asked in COSTS
        effect = (None, False) if least is None else read_least(least, f"{where}.least", is_cost)
        if effect[0] is None and named.direction == "same":
            raise InputError(f"{where}.least is needed: a difference below which both are the same")
        found.append((name, named, sign, effect))
    return tuple(found)


def check_looks(trials: Sequence[Trial], rows: Sequence[Planned]) -> tuple[int, ...]:
    """The seeds of a sweep in looks, in order; raises InputError if it cannot be run in looks."""
    what = "launch.stop_when_decided"
    if len({trial.files.home for trial in trials}) > 1:
        raise InputError(f"{what}: all trials of the sweep need one name")
    first: tuple[int, ...] = ()
    for (scene, arm), group in group_by(rows, lambda row: (row.scene, row.arm)).items():
        seeds = tuple(dict.fromkeys(row.seed for row in group))
        first = first or seeds
        if seeds != first:
            raise InputError(
                f"{what} needs the same seeds everywhere: {arm} on {scene} has "
                f"{', '.join(map(str, seeds))}, others {', '.join(map(str, first))}"
            )
    if len(first) < FIRST_LOOK:
        raise InputError(
            f"{what} needs at least {FIRST_LOOK} seeds, as seed=0,1,2,3: the most it adds"
        )
    return first


def forget_refused(trials: Sequence[Trial]) -> None:
    """Remove the trials of a command of which all were refused, unless their training has begun."""
    for home, own in group_by(trials, "files.home").items():
        begun = (RESULTS, ASKED)
        folders = {trial.folder for trial in own}
        remove(home, [one for one in folders if not any((one / name).exists() for name in begun)])


def remove(home: Path, folders: Collection[Path]) -> None:
    """Delete the folders of trials and drop them from the plan of the experiment in ``home``.

    The results of stages stay in the store: if the old code comes back, nothing is computed again.
    That they gave results stays known, so they count as tries.
    """
    for folder in folders:
        require_no_links(home.parent, folder, below=True)
        # first: a half-deleted trial must not look complete
        (folder / RESULTS).unlink(missing_ok=True)
        if folder.is_dir():
            shutil.rmtree(folder)
    drop(home, folders)
