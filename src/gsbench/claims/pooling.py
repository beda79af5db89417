"""Results of many laboratories in one: random-effects meta-analysis, with a mean only where protocols agree.

Each study has an effect and its standard error; effects differ between studies by a deviation of their own, tau. Its
estimate is that of restricted maximum likelihood (Viechtbauer 2005, *J. Educ. Behav. Stat.* 30, 261), the interval of
the mean that of Hartung and Knapp (2001, *Stat. Med.* 20, 1771), which few studies need; it is never narrower than the
plain one (Röver, Knapp and Friede 2015, *BMC Med. Res. Methodol.* 15, 99).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, special

from gsbench.analysis.report.charts import ForestRow, forest_plot
from gsbench.analysis.statistics import ALPHA, Interval
from gsbench.errors import InputError

MIN_STUDIES = 2
MIN_FOR_PREDICTION = 3  # its interval has k - 2 degrees of freedom
ABOVE_SPREAD = 10.0  # tau squared is looked for up to so many times the variance of the effects

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Study:
    """One archive's difference of two arms in one metric.

    ``conditions`` are what studies must share before a mean of them means anything: protocol, metric, and whatever else
    the caller holds for such. ``budget`` says what limited the growth of its arms; "" where nobody knows.
    """

    name: str
    effect: float
    error: float
    conditions: Mapping[str, str] = field(default_factory=dict)
    budget: str = ""

    @property
    def interval(self) -> Interval:
        half = float(special.ndtri(1 - ALPHA / 2)) * self.error
        return Interval(self.effect - half, self.effect + half)


@dataclass(frozen=True)
class Pooled:
    """``mean`` and what goes with it are None where ``refusal`` says why there is no mean.

    ``tau2`` is the variance of effects between studies, ``i2`` its share of all variance (Higgins and Thompson 2002),
    ``q`` and ``q_p`` Cochran's test that there is none. ``prediction`` is where the effect of a further study would
    lie (Higgins, Thompson and Spiegelhalter 2009), None below three studies. ``weights`` add up to one.
    """

    studies: tuple[Study, ...]
    refusal: str = ""
    mean: float | None = None
    interval: Interval | None = None
    p: float | None = None
    tau2: float | None = None
    i2: float | None = None
    q: float | None = None
    q_p: float | None = None
    prediction: Interval | None = None
    weights: tuple[float, ...] = ()


def pool(studies: Sequence[Study]) -> Pooled:
    """The random-effects mean of studies; without one, and with the reason, where they are of unlike conditions.

    Raises InputError for an effect or error that is no finite number, or a study that stands twice.
    """
    _check(studies)
    refusal = _refusal(studies)
    if refusal:
        return Pooled(tuple(studies), refusal)
    effects = np.array([study.effect for study in studies])  # [k]
    variances = np.array([study.error**2 for study in studies])  # [k]
    count = len(studies)
    tau2 = restricted_likelihood_tau2(effects, variances)
    mean, error = mean_of(effects, variances, tau2)
    weights = 1 / (variances + tau2)
    half = float(special.stdtrit(count - 1, 1 - ALPHA / 2)) * error
    plain = 1 / variances
    q = float(plain @ (effects - plain @ effects / plain.sum()) ** 2)
    typical = (count - 1) * plain.sum() / (plain.sum() ** 2 - (plain**2).sum())  # variance within a usual study
    prediction = None
    if count >= MIN_FOR_PREDICTION:
        reach = float(special.stdtrit(count - 2, 1 - ALPHA / 2)) * math.sqrt(tau2 + error**2)
        prediction = Interval(mean - reach, mean + reach)
    return Pooled(
        tuple(studies),
        mean=mean,
        interval=Interval(mean - half, mean + half),
        p=float(2 * special.stdtr(count - 1, -abs(mean / error))),
        tau2=tau2,
        i2=float(tau2 / (tau2 + typical)),
        q=q,
        q_p=float(special.chdtrc(count - 1, q)),
        prediction=prediction,
        weights=tuple(float(weight) for weight in weights / weights.sum()),
    )


def mean_of(effects: Array, variances: Array, tau2: float) -> tuple[float, float]:
    """(mean, standard error) of ``effects`` [k] with a variance ``tau2`` between them, by Hartung and Knapp."""
    weights = 1 / (variances + tau2)
    mean = float(weights @ effects / weights.sum())
    scale = max(1.0, float(weights @ (effects - mean) ** 2) / (len(effects) - 1))
    return mean, math.sqrt(scale / weights.sum())


def restricted_likelihood_tau2(effects: Array, variances: Array) -> float:
    """The variance between studies that makes the restricted likelihood of ``effects`` [k] largest; 0 at the least."""

    def loss(tau2: float) -> float:
        weights = 1 / (variances + tau2)
        mean = weights @ effects / weights.sum()
        return float(-np.log(weights).sum() + np.log(weights.sum()) + weights @ (effects - mean) ** 2)

    most = ABOVE_SPREAD * float(effects.var(ddof=1))
    if most == 0:
        return 0.0
    found = optimize.minimize_scalar(loss, bounds=(0.0, most), method="bounded", options={"xatol": 1e-10 * most})
    return float(found.x) if found.fun < loss(0.0) else 0.0


def pooled_forest(pooled: Pooled, title: str, label: str, better: int = 0) -> str:
    """The forest plot as SVG: a row for each study, and one for their mean where there is one."""
    rows = [ForestRow(one.name, one.effect, one.interval.low, one.interval.high) for one in pooled.studies]
    if pooled.mean is not None and pooled.interval is not None:
        rows.append(ForestRow("all together", pooled.mean, pooled.interval.low, pooled.interval.high))
    return forest_plot(title, rows, label, better)


def describe(pooled: Pooled) -> list[str]:
    """The result in sentences."""
    if pooled.mean is None or pooled.interval is None:
        return [f"no mean: {pooled.refusal}"]
    assert pooled.tau2 is not None
    assert pooled.i2 is not None
    lines = [
        f"mean {pooled.mean:+.4g} (95 % interval {pooled.interval.low:+.4g} to {pooled.interval.high:+.4g}) "
        f"of {len(pooled.studies)} studies",
        f"between studies: deviation {math.sqrt(pooled.tau2):.3g}, {100 * pooled.i2:.0f} % of all variance (Q "
        f"{pooled.q:.1f}, p {pooled.q_p:.3f})",
    ]
    if len({study.budget for study in pooled.studies}) > 1:
        budgets = "; ".join(f"{study.name}: {study.budget or 'not known'}" for study in pooled.studies)
        lines.append(
            f"caution: unlike budgets ({budgets}): at one count, and where each arm grows as it likes, a difference "
            "answers two questions, and this mean neither of them"
        )
    if pooled.prediction is not None:
        lines.append(
            f"a further study would lie between {pooled.prediction.low:+.4g} and {pooled.prediction.high:+.4g}"
        )
    return lines


def _check(studies: Sequence[Study]) -> None:
    for study in studies:
        if not math.isfinite(study.effect) or not math.isfinite(study.error) or study.error <= 0:
            raise InputError(
                f"{study.name}: its effect must be a number and its standard error one above 0, got {study.effect} and "
                f"{study.error}: run at least two seeds"
            )
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
