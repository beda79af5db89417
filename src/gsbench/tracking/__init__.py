"""Tracking: the files of a trial mirrored to MLflow, TensorBoard or Weights & Biases.

Trials write only files. A process beside them follows the files and writes to the tracker in
batches, so a tracker that is slow, down or read-only never harms a trial. ``gsbench sync`` sends
later what the tracker missed.
"""

from gsbench.tracking.comparison import publish
from gsbench.tracking.mirror import Mirror
from gsbench.tracking.mlflow_sink import (
    MLflow,
    connect,
    default_uri,
    ensure_experiment,
    tracker_uri,
)
from gsbench.tracking.sinks import Run, Sink, TensorBoard, WandB
from gsbench.tracking.trial import Picture, Scalar, TrackedTrial

__all__ = [
    "MLflow",
    "Mirror",
    "Picture",
    "Run",
    "Scalar",
    "Sink",
    "TensorBoard",
    "TrackedTrial",
    "WandB",
    "connect",
    "default_uri",
    "ensure_experiment",
    "publish",
    "tracker_uri",
]
