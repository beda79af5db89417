"""Tables, statistics and reports from result files. Knows result files only, and loads no torch."""

from gsbench.analysis.cells import to_frame
from gsbench.analysis.results import load_experiment

__all__ = ["load_experiment", "to_frame"]
