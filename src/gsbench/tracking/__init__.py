"""Tracking: the files of a trial mirrored to MLflow, TensorBoard or Weights & Biases.

Trials write only files. ``gsbench sync`` sends to the tracker what it lacks; beside a sweep a
process does so every minute and whenever a trial ends. So a tracker that is slow, down or
read-only never harms a trial.
"""

from gsbench.tracking.beside import Mirror
from gsbench.tracking.ideas import show_ideas
from gsbench.tracking.mlflow_sink import (
    MLflow,
    connect,
    default_uri,
    ensure_experiment,
    tracker_uri,
)
from gsbench.tracking.sinks import Run, Sink, TensorBoard, WandB
from gsbench.tracking.trial import Picture, Scalar, TrackedTrial, Update

__all__ = [
    "MLflow",
    "Mirror",
    "Picture",
    "Run",
    "Scalar",
    "Sink",
    "TensorBoard",
    "TrackedTrial",
    "Update",
    "WandB",
    "connect",
    "default_uri",
    "ensure_experiment",
    "show_ideas",
    "tracker_uri",
]
