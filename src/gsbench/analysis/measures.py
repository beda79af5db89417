"""Measures that a claim may be about: a trial's metrics, counts, times, and error where photographs are textured.

Every measure is one number of a trial. Counts and times are compared as ratios, metrics as differences or as ratios.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from gsbench.analysis.errors_by_region import absolute_error, read_ignored, read_image, texture_energy, view_names
from gsbench.analysis.results import TrialResult
from gsbench.errors import InputError
from gsbench.eval.facts import find, from_record, known_keys
from gsbench.records import Number, Part, read_if_sound
from gsbench.runs.layout import FROM_PIXELS, GROUND_TRUTH, RENDERS

TEXTURED = "error_textured"
TEXTURED_SHARE = 0.2  # of a photograph's pixels, those with the most texture


@dataclass(frozen=True)
class Measure:
    """A number of a trial; ``cost``: a count or a time, whose differences mean something as ratios alone."""

    key: str
    name: str
    read: Callable[[TrialResult], float | None] = field(compare=False, repr=False)
    cost: bool = False
    decimals: int = 3


@dataclass(frozen=True, kw_only=True)
class FromPixels(Part):
    """Measures of a trial's pictures, as an archive keeps them, which has no pictures."""

    error_textured: Number


def textured_error(trial: TrialResult) -> float:
    """Mean absolute error (8-bit levels) over the most textured fifth of each held-out photograph, mean over views.

    Grass, foliage, fabric and gravel lie there. Raises InputError where renders are missing, and so is their measure.
    """
    kept = read_if_sound(trial.path / FROM_PIXELS, FromPixels)
    if kept is not None:
        return float(kept.error_textured)
    errors = []
    for view in view_names(trial):
        truth = read_image(trial.path / GROUND_TRUTH / f"{view}.png")
        texture = texture_energy(truth)  # [H, W]
        ignored = read_ignored(trial, view)
        counts = np.ones(texture.shape, dtype=bool) if ignored is None else ~ignored
        inside = counts & (texture >= np.quantile(texture[counts], 1 - TEXTURED_SHARE))
        errors.append(float(absolute_error(read_image(trial.path / RENDERS / f"{view}.png"), truth)[inside].mean()))
    return float(np.mean(errors))


COSTS = {
    "gaussians": Measure("gaussians", "Gaussians", lambda trial: _positive(trial.record.num_gaussians), True),
    "init_points": Measure(
        "init_points", "initial points", lambda trial: _positive(trial.record.num_init_points), True
    ),
    "train_time": Measure(
        "train_time", "training time", lambda trial: _positive(trial.record.seconds.get("train")), True
    ),
    "peak_memory_mb": Measure(
        "peak_memory_mb", "peak memory", lambda trial: _positive(trial.record.peak_memory_mb), True
    ),
}
REGIONS = {TEXTURED: Measure(TEXTURED, "error in textured parts (levels)", textured_error, decimals=2)}


def measure_names() -> tuple[str, ...]:
    """The names that the ``metric`` of a claim may have, apart from a user's own."""
    return (*known_keys(), *REGIONS, *COSTS)


def find_measure(key: str, trials: Sequence[TrialResult] = ()) -> Measure:
    """The measure ``key``; of a user's own metric, what the trials' files say of it."""
    known = REGIONS.get(key) or COSTS.get(key)
    if known is not None:
        return known
    records = [trial.record.metric_facts.get(key) for trial in trials if key in trial.metrics]
    facts = find(key) or from_record(key, records[0] if records else None)
    return Measure(key, facts.name, lambda trial: trial.metrics.get(key), decimals=facts.decimals)


def read_measure(measure: Measure, trial: TrialResult) -> float:
    """The trial's value; raises InputError that says why there is none."""
    value = measure.read(trial)
    if value is None:
        raise InputError(trial.unavailable.get(measure.key, f"{trial.label} has no {measure.name}"))
    return value


def _positive(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) and value > 0 else None
