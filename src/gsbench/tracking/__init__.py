"""The mirror: what the files of a trial say, shown in MLflow, TensorBoard or Weights & Biases.

Files come first. A process beside the trials follows them and writes to the tracker in batches, so a tracker that is
slow, down or read-only never harms a trial; what it missed, ``gsbench sync`` adds later from the same files.
"""

from gsbench.tracking.mirror import Mirror
from gsbench.tracking.mlflow_sink import connect, default_uri, ensure_experiment, tracker_uri

__all__ = ["Mirror", "connect", "default_uri", "ensure_experiment", "tracker_uri"]
