"""The metrics of a trial's test views, from its ``per_view.csv``, which must agree with the trial's own means."""

from __future__ import annotations

import math

from gsbench.analysis.results import TrialResult
from gsbench.errors import InputError
from gsbench.parsing import DamagedError
from gsbench.runs.layout import PER_VIEW

MEAN_TOLERANCE = 1e-6  # relative: per-view values must average to the trial's metric


def read_views(trial: TrialResult) -> dict[str, dict[str, float]]:
    """The metrics of every test view, ``{view: {metric: value}}``; raises ``InputError`` where the file is damaged.

    The file must average to the trial's own metrics, so that a truncated one cannot pass.
    """
    path = trial.path / PER_VIEW
    try:
        views = trial.folder.views()
    except FileNotFoundError:
        raise InputError(f"{path} is missing: give the trial's own command again") from None
    except DamagedError as error:
        raise InputError(f"{error}: delete it, and give the trial's own command again") from None
    for key, expected in trial.metrics.items():
        values = [view[key] for view in views.values() if key in view]
        mean = math.fsum(values) / len(values) if values else math.nan
        if len(values) != len(views) or not math.isclose(
            mean, expected, rel_tol=MEAN_TOLERANCE, abs_tol=MEAN_TOLERANCE
        ):
            raise InputError(
                f"{path} does not average to the {key} of its trial ({mean:.6g}, not {expected:.6g}): damaged"
            )
    return views
