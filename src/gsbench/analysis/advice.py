"""The settings that compare arms again, at equal numbers of Gaussians."""

import math
from collections.abc import Callable, Iterable, Sequence

from gsbench.analysis.results import TrialResult

DIGITS = 3  # significant digits of a number of Gaussians
GRIDS = "hydra.sweeper.grids"
CAP, LIMIT = "densify.cap", "densify.max_gaussians"


# of the trials of a baseline, and of those of one arm or more
Advice = Callable[[Sequence[TrialResult], Sequence[TrialResult]], str]


def start_smaller(trials: Iterable[TrialResult]) -> str:
    """The advice where an arm ended with no more Gaussians than initial points; "" elsewhere."""
    records = [trial.record for trial in trials]
    points = max((record.num_init_points or 0 for record in records), default=0)
    if all((record.num_gaussians or math.inf) > points for record in records):
        return ""
    return f"start all arms with fewer than {points:,} points, as no limit can be below these"


def train_longer(trials: Iterable[TrialResult]) -> str:
    """The advice where arms differ although all are steered to one count; "" elsewhere."""
    aims = {(trial.config.get(CAP), trial.config.get(LIMIT)) for trial in trials}
    if len(aims) > 1 or {cap for cap, _ in aims} != {"governor"}:
        return ""
    return "train longer, since the governor (densify.cap) had too few rounds to reach its count"


def equal_counts_words(baseline: Sequence[TrialResult], arms: Sequence[TrialResult]) -> str:
    """The words for arms that all end with the count of the smallest trial; "" without counts."""
    counts = [trial.record.num_gaussians for trial in (*baseline, *arms)]
    known = [count for count in counts if count]
    if not known:
        return ""
    unit = 10 ** max(0, math.floor(math.log10(min(known))) + 1 - DIGITS)
    return f"{CAP}=governor {LIMIT}={min(known) // unit * unit}"


def equal_counts_settings(baseline: Sequence[TrialResult], arms: Sequence[TrialResult]) -> str:
    """The advice to add `equal_counts_words` where the arms are written; "" without counts."""
    words = equal_counts_words(baseline, arms)
    return words and f"give all arms {words} and another name"
