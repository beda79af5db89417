"""Sentences that stand at every verdict on two arms, wherever it is shown: what else may have made a difference."""

from __future__ import annotations

from collections.abc import Sequence

from gsbench.analysis.attribution import attribute, attribution_sentence
from gsbench.analysis.results import Arm, TrialResult
from gsbench.analysis.tuning import tuning_sentence


def caveats(trials: Sequence[TrialResult], first: Arm, second: Arm) -> str:
    """Say where two arms of ``trials`` differ in more than one ingredient, and where one was tuned more; else ""."""
    mixed = attribution_sentence(attribute(trials, first, second), first, second)
    return " ".join(filter(None, [mixed, tuning_sentence(trials, (first, second))]))
