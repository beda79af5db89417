"""Records that stages leave in the store beside their files: ``training.json`` and ``metrics.json``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from gsbench.records import Amount, Count, Number, Part, read_typed
from gsbench.runs.layout import METRICS, TRAINING
from gsbench.runs.trial_record import Earlier, Iteration, MetricRecord, Trainer


@dataclass(frozen=True, kw_only=True)
class Training(Part):
    """Record of what a training took and gave; of another program's, ``trained_by`` and ``evaluated_from`` are set."""

    iterations: Count
    num_init_points: Count
    num_gaussians: Count | None
    causes: dict[str, Count]
    scene_extent: Amount
    seconds: Amount
    peak_memory_mb: Amount | None
    machine: dict[str, str]
    checkout: dict[str, Any] = field(default_factory=dict)  # the commit of gsbench's own, and whether it was edited
    evaluated_from: Literal["model", "renders"] | None = None
    trained_by: Trainer | None = None


@dataclass(frozen=True, kw_only=True)
class Evaluation(Part):
    """The means of the metrics, why others are missing, and which of those may still come."""

    metrics: dict[str, Number]
    unavailable: dict[str, str]
    awaited: list[str]
    facts: dict[str, MetricRecord] = field(default_factory=dict)  # of a user's own metrics
    at: dict[Iteration, Earlier] = field(default_factory=dict)  # by earlier iterations


def read_training(folder: Path) -> Training:
    """The record of the training in ``folder``; raises FileNotFoundError and DamagedError."""
    return read_typed(folder / TRAINING, Training)


def read_evaluation(folder: Path) -> Evaluation:
    """The record of the evaluation in ``folder``; raises as `read_training` does."""
    return read_typed(folder / METRICS, Evaluation)
