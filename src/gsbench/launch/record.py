"""Adding to the plan (`gsbench.runs.plan`) and the declarations (`gsbench.runs.experiments`).

A command does this before its trials run. Loads no torch.
"""

import logging
import os
import shutil
import time
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import reduce
from pathlib import Path

from gsbench.config.compose import Trial
from gsbench.errors import InputError
from gsbench.files import require_no_links, write_text
from gsbench.runs.experiments import (
    Declaration,
    Planned,
    declared_now,
    make_home,
    merge_planned,
    of_latest_metric,
    open_question,
    read_declarations,
    record_text,
    unix_time,
)
from gsbench.runs.layout import CONFIG, DECLARED, FORGOTTEN, PER_VIEW, RESULTS, SEED
from gsbench.runs.plan import PlannedTrial, change_plan
from gsbench.runs.trial_folder import TrialFolder
from gsbench.system.locks import hold
from gsbench.words import some_of

log = logging.getLogger(__name__)


def add_to_plan(trials: Sequence[Trial]) -> None:
    """Add the trials to the plans of their experiments.

    A trial without overrides was read from its own record. It is not added, because in a plan no
    overrides mean the defaults.
    """
    by_home: dict[Path, dict[Path, PlannedTrial]] = {}
    for trial in trials:
        if trial.overrides:
            planned = PlannedTrial(
                overrides=tuple(trial.overrides), cwd=os.getcwd(), time=time.time()
            )
            by_home.setdefault(trial.files.home, {})[trial.folder] = planned
    for home, added in by_home.items():
        change_plan(home, added)


def remove(home: Path, folders: Iterable[Path]) -> None:
    """Delete the folders of trials and drop them from the plan of the experiment in ``home``.

    The results of stages stay in the store: if the old code comes back, nothing is computed again.
    What was measured stays in `FORGOTTEN`: it was seen, so verdicts count its code as a version.
    """
    folders = list(folders)
    for folder in folders:
        kept = home / FORGOTTEN / folder.relative_to(home)
        for place in (folder, kept):
            require_no_links(home.parent, place, below=True)
        kept.mkdir(parents=True, exist_ok=True)
        for name in (CONFIG, PER_VIEW, RESULTS):
            if (folder / name).exists():
                shutil.copy2(folder / name, kept / name)
        # first: a half-deleted trial must not look complete
        (folder / RESULTS).unlink(missing_ok=True)
        shutil.rmtree(folder)
    change_plan(home, dropped=folders)


# ---- declarations


def declared_metrics(trials: Sequence[Trial]) -> dict[Path, str | None]:
    """The metric that trials declare (``eval.primary``) or None, by the experiment's folder.

    Raises InputError if trials of one experiment declare different metrics.
    """
    metrics: dict[Path, str | None] = {}
    for trial in trials:
        home = trial.files.home
        metric, before = trial.values["eval"].get("primary"), metrics.get(home)
        if metric and before and metric != before:
            raise InputError(
                f"trials of {home.name} declare eval.primary={before} and eval.primary={metric}: a "
                "verdict is about one metric, so give one of them, or run two experiments (name=…)"
            )
        metrics[home] = before or metric
    return metrics


def declare(trials: Sequence[Trial]) -> None:
    """Add a declaration to each experiment's record, unless the latest covers these trials.

    It has the metric (`declared_metrics`) and all trials, done or not. A command without a metric
    keeps the declared one: the trials that it adds are declared with that metric, with their own
    time.
    """
    for home, given in declared_metrics(trials).items():
        seeds: dict[str, set[int]] = {}
        for trial in trials:
            if trial.files.home == home:
                seeds.setdefault(trial.files.key, set()).add(trial.values["seed"])
        asked = {key: tuple(sorted(own)) for key, own in seeds.items()}
        make_home(home)
        with hold(home / f".{DECLARED}.lock", "the declarations"):
            declarations = read_declarations(home)
            latest = next(
                (declared for declared in reversed(declarations) if declared.kind == "sweep"), None
            )
            metric = given or (None if latest is None else latest.primary)
            if metric is None:
                continue
            # The declared metric stays, since the time of its first declaration decides whether a
            # verdict was declared before its trials.
            if latest is not None and given is None:
                first = of_latest_metric(
                    [declaration for declaration in declarations if declaration.kind == "sweep"]
                )[0]
                log.info("%s: %s stays declared, since %s", home.name, metric, first.when)
            before = {} if latest is None else latest.planned
            together = merge_planned(before, asked)
            # Old declarations name no trials: they cover all of this metric.
            is_covered = together == before or (latest is not None and not latest.names_trials)
            same_metric = latest is not None and latest.primary == metric
            if same_metric and is_covered:
                continue
            added = declared_now(questions=(open_question(metric),), trials=dict(together))
            added = _with_known(added, home)
            write_text(home / DECLARED, record_text([*declarations, added]))
        if same_metric:
            _warn_of_added_seeds(home, metric, before, asked)
        elif latest is not None:
            log.warning(
                "%s: %s decides on arms that have no results yet; on the others, %s does",
                home.name,
                metric,
                latest.primary,
            )


def _with_known(asked: Declaration, home: Path) -> Declaration:
    """The declaration, which names those of its trials whose results are dated later than itself.

    They are there, so a clock was ahead. By their time, they would look declared beforehand.
    """

    def is_known(folder: TrialFolder) -> bool:
        record = folder.sound_record()
        if record is None:
            return False
        moment = unix_time(record.measured)
        return (moment or (folder.path / RESULTS).stat().st_mtime) >= asked.moment

    known = {
        key: there
        for key, seeds in asked.planned.items()
        if (there := tuple(s for s in seeds if is_known(TrialFolder(home / f"{key}{SEED}{s}"))))
    }
    if known:
        log.warning(
            "%s: results of %s are dated later than now, so a clock was wrong; they count as "
            "measured before this command",
            home.name,
            some_of(sorted({key.split("/")[1] for key in known})),
        )
    return replace(asked, known=known)


def _warn_of_added_seeds(home: Path, metric: str, before: Planned, added: Planned) -> None:
    """Name the arms that get further seeds after their first result.

    Arms without a result are declared in time.
    """
    late = {
        key.split("/")[1]
        for key, seeds in added.items()
        if not set(seeds) <= set(before.get(key, ())) and any(home.glob(f"{key}{SEED}*/{RESULTS}"))
    }
    if late:
        log.warning(
            "%s: seeds are added after the first result of %s: where such an arm is compared with "
            "a baseline, %s no longer decides alone, but all metrics, adjusted for their number",
            home.name,
            some_of(sorted(late)),
            metric,
        )


def declare_questions(home: Path, asked: Declaration) -> Declaration:
    """Add the questions of a claims file, a sweep or a round of votes to the experiment's record.

    Returns the recorded declaration: if the latest one of its kind is equal, that one with its
    earlier time. In a sweep, each arm is judged by the declaration before its own first result.
    """
    if not asked.questions:
        return asked
    make_home(home)
    with hold(home / f".{DECLARED}.lock", "the declarations"):
        declarations = read_declarations(home)
        same_kind = [declared for declared in declarations if declared.kind == asked.kind]
        if same_kind and same_kind[-1].hash == asked.hash:
            return same_kind[-1]
        asked = _with_known(asked, home)
        write_text(home / DECLARED, record_text([*declarations, asked]))
    if same_kind and asked.kind == "sweep":
        before: Planned = reduce(merge_planned, (declared.planned for declared in same_kind))
        _warn_of_added_seeds(home, asked.primary, before, asked.planned)
    if same_kind and asked.kind == "claims":  # votes are judged by their own round alone
        log.warning(
            "%s: other questions were declared before: trials that were measured under them count "
            "as looked at",
            home.name,
        )
    return asked
