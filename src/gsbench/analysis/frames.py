"""Verdicts on results of any trainer: a data frame with a row for each training."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsbench.analysis import verdicts as judging
from gsbench.analysis.quantities import asked_quantity
from gsbench.analysis.questions import read_least
from gsbench.analysis.results import TrialResult, group_by
from gsbench.errors import InputError
from gsbench.eval.facts import known_keys
from gsbench.runs.commands import ERROR_RATE, Question
from gsbench.runs.trial_record import FROM_RENDERS, MetricRecord, TrialRecord
from gsbench.words import did_you_mean, listed

if TYPE_CHECKING:
    import pandas as pd

COLUMNS = ("method", "scene", "seed")
FRAME = "frame"  # the rule of a question that was not written down


def judge(
    frame: pd.DataFrame,
    baseline: str,
    metric: str,
    least: float | str | None = None,
    direction: int = 0,
    questions: Mapping[str, Question] | None = None,
) -> dict[str, judging.Verdict]:
    """The verdict on each method of a ``frame`` against ``baseline`` in ``metric``, by its name.

    The frame has the columns method, scene, seed and metrics, a row for each training. ``least`` is
    the least difference that matters, such as 0.1 or "10%"; by default the metric's usual one.
    ``direction`` (1: more is better, -1: less) is needed for metrics that gsbench does not know.
    ``questions`` are those that were written down before the training; without them, a verdict
    holds at 5 % if metric, scenes and seeds were chosen before.

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
    trials = trials_of(frame, metric, direction)
    by_method = group_by(trials, lambda trial: trial.densify)
    if baseline not in by_method:
        raise InputError(
            f"no method {baseline!r}{did_you_mean(baseline, by_method)} (there are "
            f"{listed(list(by_method))})"
        )
    asked = dict(questions or {}) or {
        method: question_of(by_method[baseline], own, metric, least)
        for method, own in by_method.items()
        if method != baseline
    }
    return {name: judging.judge(trials, question) for name, question in asked.items()}


def question_of(
    baseline: list[TrialResult],
    idea: list[TrialResult],
    metric: str,
    least: float | str | None = None,
) -> Question:
    """The question about all scenes and seeds that an idea shares with its baseline."""
    quantity = asked_quantity(metric, [*baseline, *idea])
    if not quantity.direction:
        raise InputError(f"{metric}: say whether more is better (direction 1) or less (-1)")
    effect = None if least is None else read_least(least, "least")
    one, two = (group_by(own, lambda trial: trial.scene) for own in (baseline, idea))
    seeds = {
        scene: tuple(sorted({t.seed for t in one[scene]} & {t.seed for t in two[scene]}))
        for scene in sorted(one.keys() & two.keys())
    }
    seeds = {scene: own for scene, own in seeds.items() if own}
    return Question(
        idea=idea[0].arm,
        baseline=baseline[0].arm,
        metric=metric,
        sign=quantity.direction,  # type: ignore[arg-type]
        least=quantity.worthwhile if effect is None else effect.size,
        relative=effect is not None and effect.relative,
        digests=dict.fromkeys(seeds, (baseline[0].digest, idea[0].digest)),
        seeds=seeds,
        level=ERROR_RATE,
        rule=FRAME,
    ).with_id(FRAME)


def trials_of(frame: pd.DataFrame, metric: str, direction: int = 0) -> list[TrialResult]:
    """The rows of a frame as trials; raises InputError for a frame that cannot be read."""
    if missing := [name for name in (*COLUMNS, metric) if name not in frame.columns]:
        raise InputError(
            f"the table has no column {missing[0]!r}: it needs {', '.join(COLUMNS)} and {metric} "
            f"(it has {listed(list(map(str, frame.columns)))})"
        )
    if not len(frame):
        raise InputError("the table has no rows")
    twice = frame.duplicated(list(COLUMNS))
    if twice.any():
        first = frame[twice].iloc[0]
        raise InputError(
            f"{first['method']}, {first['scene']}, seed {first['seed']} is twice in it"
        )
    names = [
        str(name)
        for name in frame.columns
        if name not in COLUMNS and frame[name].dtype.kind in "fiu"
    ]
    return [_trial(row, names, direction) for row in frame.to_dict("records")]


def _trial(row: Mapping[Any, Any], names: list[str], direction: int) -> TrialResult:
    values = {name: float(row[name]) for name in names if row[name] == row[name]}  # without NaN
    own = {
        name: MetricRecord(label=name, direction=1 if direction > 0 else -1 if direction else 0)
        for name in names
        if name not in known_keys()
    }
    method, scene = str(row["method"]), str(row["scene"])
    try:
        seed = int(row["seed"])
    except (TypeError, ValueError):
        raise InputError(f"the seed {row['seed']!r} is not a whole number") from None
    record = TrialRecord(
        status="complete",
        experiment=FRAME,
        scene=scene,
        init="",
        densify=method,
        seed=seed,
        raster="unknown",
        protocol="unknown",
        iterations=0,
        metrics=values,
        metric_facts=own,
        unavailable={},
        seconds={},
        num_init_points=None,
        num_gaussians=None,
        peak_memory_mb=None,
        hashes={},
        versions={},
        evaluated_from=FROM_RENDERS,
        questions=[FRAME],
    )
    path = Path(FRAME, scene, method, f"{seed}")
    trial = TrialResult(path, "", record)
    return replace(trial, alias=method)
