"""Tracking: the files of a trial mirrored to MLflow, TensorBoard or Weights & Biases.

Trials write only files. A process beside them follows the files and writes to the tracker in
batches, so a tracker that is slow, down or read-only never harms a trial. ``gsbench sync`` sends
later what the tracker missed.
"""

from gsbench.tracking.comparison import publish
from gsbench.tracking.mirror import Mirror
from gsbench.tracking.mlflow_sink import connect, default_uri, ensure_experiment, tracker_uri

__all__ = ["Mirror", "connect", "default_uri", "ensure_experiment", "publish", "tracker_uri"]
