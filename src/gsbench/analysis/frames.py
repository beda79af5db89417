"""Results of any trainer in a table (method, scene, seed, metrics), judged as trials are.

Nobody wrote the question down before these results, so its sentence states the condition. A file of
`Declared`, written before the training, takes the condition away.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from gsbench.analysis.comparison import Comparison, compare
from gsbench.analysis.quantities import COSTS, asked_quantity
from gsbench.analysis.questions import read_least
from gsbench.analysis.results import Experiment, TrialResult, Unfinished, group_by
from gsbench.analysis.verdicts import Verdict
from gsbench.errors import InputError
from gsbench.eval.facts import find_metric
from gsbench.parsing import Count, Record, Text
from gsbench.runs.commands import Command, History, Question
from gsbench.runs.experiments import Arm
from gsbench.runs.layout import SEED
from gsbench.runs.trial_record import MetricRecord, TrialRecord
from gsbench.words import did_you_mean, listed

if TYPE_CHECKING:
    import pandas as pd

COLUMNS = ("method", "scene", "seed")
Sign = Literal[-1, 0, 1]
DIRECTIONS: dict[str, Sign] = {"": 0, "higher": 1, "lower": -1}
BETTER: dict[int, str] = {sign: word for word, sign in DIRECTIONS.items()}


class Declared(Record):
    """A question about a table: is a method better than ``baseline`` in ``metric``?

    One that was written before the training names ``methods``, scenes and seeds; any other one is
    about all in the table.
    """

    baseline: Text
    metric: Text
    better: str = ""
    least: Text | None = None
    methods: tuple[Text, ...] = ()
    scenes: tuple[Text, ...] = ()
    seeds: tuple[Count, ...] = ()


def judge(
    frame: pd.DataFrame,
    baseline: str,
    metric: str,
    least: float | str | None = None,
    direction: int = 0,
) -> dict[str, Verdict]:
    """The verdict on each method of a ``frame`` against ``baseline`` in ``metric``, by its name.

    The frame has the columns method, scene, seed and metrics, a row for each training; a missing
    value, or a row that only one of two methods has, is a training that failed. ``least`` is the
    least difference that matters, such as 0.1 or "10%"; by default the metric's usual one.
    ``direction`` (1: more is better, -1: less) is needed for metrics that gsbench does not know. A
    verdict has 5 %, and holds if metric, scenes and seeds were chosen before.

    Raises InputError, one line, for a frame that lacks a column, has a training twice, or has no
    such baseline.

    Examples:
        >>> import pandas as pd
        >>> rows = [("base", "garden", k, 26.0 + k / 10) for k in range(3)]
        >>> rows += [("mine", "garden", k, 27.0 + k / 9) for k in range(3)]
        >>> frame = pd.DataFrame(rows, columns=["method", "scene", "seed", "psnr"])
        >>> judge(frame, "base", "psnr")["mine"].outcome
        'supported'
    """
    size = None if least is None else str(least)
    asked = Declared(baseline=baseline, metric=metric, better=BETTER[direction], least=size)
    answers = compare_methods(frame, asked).answers
    return {answer.arm.densify: answer.verdict for answer in answers}


def compare_methods(frame: pd.DataFrame, asked: Declared, name: str = "results") -> Comparison:
    """The answers on the methods of a table, as `judge` gives them.

    Raises InputError for a table or question that cannot be judged.
    """
    metric, baseline = asked.metric, asked.baseline
    trials = _trials(frame, metric, DIRECTIONS[asked.better], name)
    methods = list(dict.fromkeys(trial.densify for trial in trials))
    if baseline not in methods:
        raise InputError(
            f"no method {baseline!r}{did_you_mean(baseline, methods)} (there are {listed(methods)})"
        )
    ideas = asked.methods or [method for method in methods if method != baseline]
    if not ideas:
        raise InputError(f"the table has one method, {baseline}: nothing to compare")
    quantity = asked_quantity(metric, trials)
    if not quantity.direction:
        raise InputError(
            f"{metric}: say whether more is better (--better higher, direction 1) or less"
        )
    if asked.better and DIRECTIONS[asked.better] != quantity.direction:
        known = BETTER[quantity.direction]
        raise InputError(f"{metric} is known, and {known} values are better: leave --better out")
    least = asked.least or quantity.worthwhile
    size = (None, False) if least is None else read_least(least, "--least")
    questions = [
        _question(trials, asked, idea, quantity.direction, size).with_id("table") for idea in ideas
    ]
    folder = Path(name)
    history = History(folder, (Command(words=(), cwd="", time=0.0, questions=tuple(questions)),))
    # trainings that were declared may still come
    absent = () if asked.methods else _absent(folder, trials, questions)
    return compare(Experiment(name, folder, tuple(trials), (), unfinished=absent, history=history))


def _absent(
    folder: Path, trials: Sequence[TrialResult], questions: Sequence[Question]
) -> tuple[Unfinished, ...]:
    """The rows of the questions that the table lacks, as trials that failed."""
    there = {(trial.digest, trial.scene, trial.seed) for trial in trials}
    places = {
        (side.densify, scene, seed)
        for question in questions
        for side in (question.baseline, question.idea)
        for scene, seed in question.places
    }
    return tuple(
        Unfinished(_place(folder, scene, method, seed), _digest(method), failed=True)
        for method, scene, seed in sorted(places)
        if (_digest(method), scene, seed) not in there
    )


def _place(folder: Path, scene: str, method: str, seed: int) -> Path:
    """A path of a row, as the folder of a trial is called."""
    return folder / scene / method.replace("/", "_") / f"row{SEED}{seed}"


def _question(
    trials: Sequence[TrialResult],
    asked: Declared,
    idea: str,
    sign: int,
    least: tuple[float | None, bool],
) -> Question:
    """The question about all trials of a method, or about those that were declared."""
    rows = group_by(trials, "densify", "scene")
    untested, baseline, seeds = "", asked.baseline, dict[str, tuple[int, ...]]()
    tried = {trial.seed for trial in trials if trial.densify == idea}
    for scene in dict.fromkeys(trial.scene for trial in trials):
        first, own = (
            {one.seed for one in rows.get((side, scene), ())} for side in (baseline, idea)
        )
        # a seed of the idea that only one of both has here counts, too: the other's may have failed
        if wanted := sorted(tried & (first | own)):
            seeds[scene] = tuple(wanted)
            if not {*wanted} >= {*sorted(first)[: len(wanted)]}:
                untested = f"it leaves out seeds of {baseline} on {scene}"
    if asked.methods:
        seeds, untested = {_scene(one): asked.seeds for one in asked.scenes}, ""
    return Question(
        idea=Arm("", idea),
        baseline=Arm("", baseline),
        metric=asked.metric,
        sign=sign,  # type: ignore[arg-type]
        least=least[0],
        relative=least[1],
        digests={scene: (_digest(baseline), _digest(idea)) for scene in seeds},
        seeds=seeds,
        rule="declared table" if asked.methods else "table",
        untested=untested,
    )


def _scene(name: str) -> str:
    return name.replace("/", "_")  # it is a part of a path


def _digest(method: str) -> str:
    return method.replace("+", "_")  # what follows a plus stands for code


def _trials(frame: pd.DataFrame, metric: str, sign: Sign, name: str) -> list[TrialResult]:
    """The rows as trials; raises InputError for missing columns, repeated rows and no numbers."""
    columns = [str(column) for column in frame.columns]
    for column in (*COLUMNS, metric):
        if column not in columns:
            raise InputError(
                f"the table has no column {column!r}{did_you_mean(column, columns)} (it has "
                f"{listed(columns)}; a row needs {listed(COLUMNS)} and metrics)"
            )
    if not len(frame):
        raise InputError("the table has no rows")
    values = {key: _numbers(frame[key]) for key in columns if key not in COLUMNS}
    metrics = {key: column for key, column in values.items() if column is not None}
    if metric not in metrics:
        raise InputError(f"the column {metric} has a value that is no number")
    facts = {
        key: MetricRecord(
            label=COSTS.get(key, (key,))[0],
            direction=-1 if key in COSTS else sign if key == metric else 0,
        )
        for key in metrics
        if find_metric(key) is None
    }
    trials = []
    for number, row in enumerate(frame[list(COLUMNS)].itertuples(index=False)):
        method, scene, seed = str(row[0]), _scene(str(row[1])), _seed(row[2])
        own = {key: column[number] for key, column in metrics.items()}
        trials.append(_trial(name, method, scene, seed, own, facts))
    for place, same in group_by(trials, "densify", "scene", "seed").items():
        if len(same) > 1:
            raise InputError(f"{place[0]}, {place[1]}, seed {place[2]} is twice in it")
    return trials


def _numbers(column: Any) -> list[float] | None:
    """The values of a column, NaN for none; None if one is no number."""
    try:
        found = [float(value) for value in column]
    except (TypeError, ValueError):
        return None
    return None if any(map(math.isinf, found)) else found


def _seed(value: Any) -> int:
    try:
        if float(value) == int(value) >= 0:
            return int(value)
    except (TypeError, ValueError, OverflowError):
        pass
    raise InputError(f"seed must be a whole number from 0 on, got {value!r}")


def _trial(
    name: str,
    method: str,
    scene: str,
    seed: int,
    values: Mapping[str, float],
    facts: Mapping[str, MetricRecord],
) -> TrialResult:
    record = TrialRecord(
        status="complete",
        experiment=name,
        scene=scene,
        init="",
        densify=method,
        seed=seed,
        raster="",
        protocol="of the table",
        iterations=0,
        metrics={key: value for key, value in values.items() if not math.isnan(value)},
        unavailable={key: "no value" for key, value in values.items() if math.isnan(value)},
        seconds={},
        num_init_points=None,
        num_gaussians=None,
        peak_memory_mb=None,
        hashes={},
        versions={},
        evaluated_from="renders",
        metric_facts=dict(facts),
    )
    path = _place(Path(name), scene, method, seed)
    return replace(TrialResult(path, "", record), alias=_digest(method))
