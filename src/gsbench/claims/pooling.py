"""Results of many laboratories in one: a mean of their effects, with an interval whose error rate is known.

The units are studies, each with the same weight, by Student's t. Weights from the studies' own standard errors would
take as known what two or three seeds estimate: with the usual random-effects methods 7 to 10 % of intervals then miss
the mean (docs/verdict.md). A mean only where protocols agree.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import special

from gsbench.analysis.report.charts import ForestRow, forest_plot
from gsbench.analysis.statistics import ALPHA, Interval, student
from gsbench.errors import InputError

MIN_STUDIES = 2


@dataclass(frozen=True)
class Study:
    """One archive's difference of two arms in one metric, with its ``interval`` (None of a single pair).

    ``conditions`` are what studies must share before a mean of them means anything: protocol, metric, and whatever else
    the caller holds for such. ``budget`` says what limited the growth of its arms; "" where nobody knows.
    """

    name: str
    effect: float
    interval: Interval | None = None
    conditions: Mapping[str, str] = field(default_factory=dict)
    budget: str = ""


@dataclass(frozen=True)
class Pooled:
    """``mean`` and what goes with it are None where ``refusal`` says why there is no mean.

    ``deviation`` is that of the studies' effects; ``prediction`` is where the effect of a further study would lie.
    """

    studies: tuple[Study, ...]
    refusal: str = ""
    mean: float | None = None
    interval: Interval | None = None
    p: float | None = None
    deviation: float | None = None
    prediction: Interval | None = None


def pool(studies: Sequence[Study]) -> Pooled:
    """The mean of studies; without one, and with the reason, where they are of unlike conditions.

    Raises InputError for an effect that is no finite number, or a study that stands twice.
    """
    _check(studies)
    refusal = _refusal(studies)
    effects = np.array([study.effect for study in studies])  # [k]
    test = None if refusal else student(effects[:, None])
    if test is None:
        return Pooled(tuple(studies), refusal)
    deviation, count = float(effects.std(ddof=1)), len(studies)
    reach = float(special.stdtrit(count - 1, 1 - ALPHA / 2)) * deviation * math.sqrt(1 + 1 / count)
    prediction = Interval(test.mean - reach, test.mean + reach)
    return Pooled(tuple(studies), "", test.mean, test.interval(), test.p, deviation, prediction)


def pooled_forest(pooled: Pooled, title: str, label: str, better: int = 0) -> str:
    """The forest plot as SVG: a row for each study, and one for their mean where there is one."""
    rows = [ForestRow(one.name, one.effect, *_bounds(one.interval)) for one in pooled.studies]
    if pooled.mean is not None:
        rows.append(ForestRow("all together", pooled.mean, *_bounds(pooled.interval)))
    return forest_plot(title, rows, label, better)


def _bounds(interval: Interval | None) -> tuple[float | None, float | None]:
    return (None, None) if interval is None else (interval.low, interval.high)


def describe(pooled: Pooled) -> list[str]:
    """The result in sentences."""
    if pooled.mean is None or pooled.interval is None or pooled.prediction is None:
        return [f"no mean: {pooled.refusal}"]
    lines = [
        f"mean {pooled.mean:+.4g} (95 % interval {pooled.interval.low:+.4g} to {pooled.interval.high:+.4g}, p "
        f"{pooled.p:.3g}) "
        f"of {len(pooled.studies)} studies, each with the same weight",
        f"studies differ by a deviation of {pooled.deviation:.3g}; a further one would lie between "
        f"{pooled.prediction.low:+.4g} and {pooled.prediction.high:+.4g}",
    ]
    if len({study.budget for study in pooled.studies}) > 1:
        budgets = "; ".join(f"{study.name}: {study.budget or 'not known'}" for study in pooled.studies)
        lines.append(
            f"caution: unlike budgets ({budgets}): at one count, and where each arm grows as it likes, a difference "
            "answers two questions, and this mean neither of them"
        )
    return lines


def _check(studies: Sequence[Study]) -> None:
    for study in studies:
        if not math.isfinite(study.effect):
            raise InputError(f"{study.name}: its effect must be a number, got {study.effect}")
    names = [study.name for study in studies]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(f"{twice[0]} stands twice: results that are counted twice look surer than they are")


def _refusal(studies: Sequence[Study]) -> str:
    if len(studies) < MIN_STUDIES:
        return f"{len(studies)} of {MIN_STUDIES} studies that a mean needs"
    keys = sorted({key for study in studies for key in study.conditions})
    for key in keys:
        values = {study.name: study.conditions.get(key, "unknown") for study in studies}
        if len(set(values.values())) > 1:
            shown = "; ".join(f"{name}: {value}" for name, value in values.items())
            return f"the studies differ in {key} ({shown})"
    return ""
