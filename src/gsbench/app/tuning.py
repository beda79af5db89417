"""Tuning parity: before a sweep's trials, each arm gets the same number of points of a search, on validation views.

The plan (`gsbench.app.tuning_plan`) is declared before anything is trained. The best point's values become words of the
sweep's jobs. The searches of all arms go on side by side, one point of each at a time.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any

from omegaconf import OmegaConf

from gsbench.app.study import Values, arm_of, best_words, lie_in, words_of_values
from gsbench.app.sweep import Sweep
from gsbench.app.tuning_plan import DEFAULT_POINTS, PLACE, Plan, TuneSettings, make_plan
from gsbench.errors import GsbenchError, InputError
from gsbench.files import checked_runs_folder, make_runs_folder, write_json
from gsbench.parsing import DamagedError
from gsbench.runs.experiments import make_home
from gsbench.runs.layout import TUNING
from gsbench.runs.search_record import SearchRecord
from gsbench.runs.tuning_record import TunedArm, TuningRecord, read_tuning
from gsbench.system.locks import hold

log = logging.getLogger(__name__)


def tuned_jobs(
    begun: Sweep,
    settings: Any,
    jobs: Sequence[Sequence[str]],
    searched: Sequence[Mapping[str, str]],
) -> list[list[str]]:
    """The jobs of a sweep with the values to which each arm is tuned first: in the intervals that are ``searched`` for
    each job, and as ``settings`` (``hydra.sweeper.tune``) say.

    A tuning that is done already is taken from its record. Raises InputError for settings that fit no arm, and
    GsbenchError where no point of an arm could be judged.
    """
    given: Any = OmegaConf.to_container(settings) if OmegaConf.is_config(settings) else dict(settings)
    if any(searched) and given.get("points") is None:
        given["points"] = DEFAULT_POINTS
    wanted = TuneSettings(**given, intervals=any(searched))
    if not wanted.points:
        if any(searched):
            raise InputError(f"{PLACE}.points={wanted.points} searches nothing: give a value in place of each interval")
        return [list(job) for job in jobs]
    if not begun.config.launch.wait:
        raise InputError(f"{PLACE} learns from results, so launch.wait must be true")
    plan = make_plan(begun, wanted, jobs, searched)
    record = _done(plan)
    if begun.task.look_only:
        print(plan.describe() + ("" if record is None else "; done"))
        if record is None:
            print("what it will choose is not known yet: the arms are listed as they are")
            return [list(job) for job in jobs]
    record = _search(begun, plan, len(jobs)) if record is None else record
    return _with_chosen(begun, jobs, record)


def _done(plan: Plan) -> TuningRecord | None:
    """The record of this very tuning; None where it is not there, or not whole."""
    try:
        record = read_tuning(plan.home)
    except FileNotFoundError:
        return None
    except DamagedError as error:
        log.warning("left out: %s", error)
        return None
    if record.hash != plan.hash:
        return None
    for arm in plan.arms:
        chosen = _chosen(record, arm.name) if arm.name in record.arms else None
        if not lie_in(chosen or {}, arm.ranges):
            log.warning("left out: %s: its values of %s are not of the declared ranges", plan.home / TUNING, arm.name)
            return None
    return record


def _search(begun: Sweep, plan: Plan, first: int) -> TuningRecord:
    """Search every arm's ranges, one point of each arm at a time; ``first`` is the number of the first job."""
    make_runs_folder(checked_runs_folder(str(plan.home.parent)))
    studies = {arm.name: plan.study(arm) for arm in plan.tuned}
    by_name = {arm.name: arm for arm in plan.arms}
    for study in studies.values():
        make_home(study.home)
    with hold(plan.home / f".{TUNING}.lock", "the tuning"):
        while batch := {name: points for name, study in studies.items() if (points := study.next_points())}:
            asked = [(name, number, values) for name, points in batch.items() for number, values in points.items()]
            words = [by_name[name].trials(values, plan.seeds) for name, _, values in asked]
            trials = begun.trials([job for jobs in words for job in jobs], first)
            first += len(trials)
            begun.launch(trials)
            for (name, number, _), jobs in zip(asked, words, strict=True):
                studies[name].judge(number, trials[: len(jobs)])
                studies[name].write_record()
                trials = trials[len(jobs) :]
        record = _record(plan, {name: study.write_record() for name, study in studies.items()})
        write_json(plan.home / TUNING, record.to_json())
    return record


def _record(plan: Plan, found: Mapping[str, SearchRecord]) -> TuningRecord:
    arms = {}
    for arm in plan.arms:
        search = found.get(arm.name)
        if search is None:
            arms[arm.name] = TunedArm(ranges={})
            continue
        log.info("%s", best_words(search, arm.experiment))
        if search.best is None:
            raise GsbenchError(
                f"{PLACE}: no point of {arm.name} has a {plan.goal.metric} (gsbench status {arm.experiment} says why)"
            )
        first = arm.as_it_is is not None
        arms[arm.name] = TunedArm(ranges=dict(arm.texts), experiment=arm.experiment, as_it_is=first, search=search)
    return TuningRecord(
        hash=plan.hash, metric=plan.goal.metric, seeds=list(plan.seeds), scenes=list(plan.scenes), arms=arms
    )


def _with_chosen(begun: Sweep, jobs: Sequence[Sequence[str]], record: TuningRecord) -> list[list[str]]:
    trials = begun.trials(jobs)
    names = [arm_of(trial) for trial in trials]
    return [[*job, *words_of_values(_chosen(record, name) or {})] for job, name in zip(jobs, names, strict=True)]


def _chosen(record: TuningRecord, arm: str) -> Values | None:
    best = record.arms[arm].best
    return None if best is None else dict(best.settings)
