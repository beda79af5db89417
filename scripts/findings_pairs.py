"""Pairs of arms from a table of trials, and their differences as cells of Markdown."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from gsbench.analysis.pairing import Paired
from gsbench.analysis.statistics import Comparison
from gsbench.eval.facts import MetricFacts, find

BASELINES = ("adc", "absgrad", "sfm")  # what others are held against: among densifiers, among initialisers


def with_arms(frame: pd.DataFrame) -> pd.DataFrame:
    """Add the column ``arm``: the densifier, or the initialiser where those differ."""
    return frame.assign(arm=frame.init if frame.densify.nunique() == 1 else frame.densify)


def baseline(frame: pd.DataFrame) -> str:
    """Return the first of `BASELINES` that is among the arms."""
    return next(arm for arm in BASELINES if arm in set(frame.arm))


def arms_of(frame: pd.DataFrame) -> list[str]:
    """The baseline first, then the others as they stand in the table."""
    first = baseline(frame)
    return sorted(dict.fromkeys(frame.arm), key=lambda arm: arm != first)


def pair(frame: pd.DataFrame, arm: str, metric: str, against: str) -> Paired:
    """Pair two arms as the program does, but for the views: a trial's mean stands for them, so none is drawn anew."""
    one, other = (frame[frame.arm == name].set_index(["scene", "seed"])[metric].sort_index() for name in (against, arm))
    both = one.index.intersection(other.index)
    differences = (other[both] - one[both]).dropna()
    scenes = tuple(dict.fromkeys(differences.index.get_level_values("scene")))
    matrices = tuple(np.asarray(differences[scene], float)[:, None] for scene in scenes)
    return Paired(metric, scenes, matrices, float(one[both].groupby("scene").mean().mean()), ())


def difference(c: Comparison, digits: int) -> str:
    """Write a mean with its 95 % interval and p of its family; bold where the program would decide."""
    interval = f" [{c.interval.low:+.{digits}f}, {c.interval.high:+.{digits}f}]" if c.interval else ""
    p = c.p_family
    chance = "" if p is None else f"p {p:.3f}" if p >= 0.001 else "p < .001"
    if c.verdict != "no evidence":
        chance = f"**{chance}**"
    return ", ".join(filter(None, [f"{c.mean:+.{digits}f}{interval}", chance]))


def facts(metric: str) -> MetricFacts:
    """Return what gsbench knows of a metric of its own."""
    found = find(metric)
    assert found is not None
    return found


def row(cells: Sequence[str]) -> str:
    """A line of a Markdown table."""
    return "| " + " | ".join(cells) + " |"
