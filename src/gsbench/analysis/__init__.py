"""Tables, statistics and reports. They are made from result files alone, without torch."""

from gsbench.analysis.cells import to_frame
from gsbench.analysis.results import load_experiment

__all__ = ["load_experiment", "to_frame"]
