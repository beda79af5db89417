"""Sentences that stand at every verdict on two arms, wherever it is shown: what else may have made a difference."""

from __future__ import annotations

from collections.abc import Sequence

from gsbench.analysis.attribution import attribute, attribution_sentence
from gsbench.analysis.cells import by_key
from gsbench.analysis.pairing import arm_name
from gsbench.analysis.results import Arm, TrialResult
from gsbench.analysis.tuning import tuning_sentence

EQUAL_COUNTS = 0.02  # relative: arms closer than this have one count, as governed ones do


def caveats(trials: Sequence[TrialResult], first: Arm, second: Arm) -> str:
    """Say where two arms of ``trials`` have unlike counts, differ in more than one ingredient, and where one was tuned
    more; else "".
    """
    mixed = attribution_sentence(attribute(trials, first, second), first, second)
    counts = counts_sentence(trials, first, second)
    return " ".join(filter(None, [counts, mixed, tuning_sentence(trials, (first, second))]))


def counts_sentence(trials: Sequence[TrialResult], first: Arm, second: Arm) -> str:
    """Say how many more Gaussians the second arm has, over the scenes that both have; "" where counts are equal."""
    means = []
    for arm in (first, second):
        own = by_key([trial for trial in trials if trial.arm == arm], lambda trial: trial.scene)
        counts = {scene: [trial.record.num_gaussians or 0 for trial in group] for scene, group in own.items()}
        means.append({scene: sum(found) / len(found) for scene, found in counts.items() if all(found)})
    shared = means[0].keys() & means[1].keys()
    if not shared:
        return ""
    change = sum(means[1][scene] for scene in shared) / sum(means[0][scene] for scene in shared) - 1
    if abs(change) <= EQUAL_COUNTS:
        return ""
    more = f"{abs(change):.0%}".replace("%", " %") + (" more" if change > 0 else " fewer")
    return (
        f"{arm_name(second)} has {more} Gaussians than {arm_name(first)}: this is no comparison at one count, which "
        "densify.cap=governor makes."
    )
