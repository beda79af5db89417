"""An experiment as a data frame: one row a trial, for notebooks, for other programs, and as CSV."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from gsbench.analysis.cells import swept_settings
from gsbench.analysis.quantities import metric_keys
from gsbench.analysis.results import Experiment, TrialResult

if TYPE_CHECKING:
    import pandas as pd

NAMES = ("experiment", "scene", "init", "densify", "seed")
CONDITIONS = ("protocol", "raster", "iterations")
COUNTS = ("num_init_points", "num_gaussians", "scene_extent", "peak_memory_mb", "train_views", "test_views")


def to_frame(trials: Experiment | Sequence[TrialResult]) -> pd.DataFrame:
    """The complete trials of an experiment, or some of them, as a data frame with these columns:

    - ``experiment``, ``scene``, ``init``, ``densify``, ``seed``: which trial it is;
    - every setting that was swept within those, by its dotted key, such as ``densify.max_gaussians``;
    - ``protocol``, ``raster``, ``iterations``, and ``width`` and ``height`` of the views in px;
    - every metric that some trial has, as the mean over its test views (``psnr`` in dB; not a number where it could
      not be computed);
    - ``num_init_points``, ``num_gaussians``, ``scene_extent`` (world units), ``peak_memory_mb``, ``train_views`` and
      ``test_views``;
    - ``seconds_init``, ``seconds_train``, ``seconds_evaluate``;
    - ``event_<cause>``: how many Gaussians the refinements cloned, split, pruned and so on, by cause;
    - ``hash_config``, ``hash_data``, ``hash_init`` and so on: what the trial came from;
    - ``folder``: where its files lie.

    What a trial lacks is missing in its row, never 0.
    """
    import pandas as pd  # here, since it is slow to import

    chosen = list(trials.trials if isinstance(trials, Experiment) else trials)
    swept, metrics = swept_settings(chosen), metric_keys(chosen)
    rows = []
    for trial in chosen:
        record = trial.record
        row: dict[str, Any] = {name: getattr(record, name) for name in NAMES}
        row |= {key: trial.config.get(key) for key in swept}
        row |= {name: getattr(record, name) for name in CONDITIONS}
        row |= dict(zip(("width", "height"), record.resolution or (None, None), strict=True))
        row |= {key: trial.metrics.get(key) for key in metrics} | {name: getattr(record, name) for name in COUNTS}
        for prefix, group in (("seconds", record.seconds), ("event", record.events), ("hash", record.hashes)):
            row |= {f"{prefix}_{key}": value for key, value in group.items()}
        rows.append(row | {"folder": str(trial.path)})
    return pd.DataFrame(rows).convert_dtypes(convert_string=False, convert_floating=False)
