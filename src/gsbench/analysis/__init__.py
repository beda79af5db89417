"""Tables, statistics and reports. They are made from result files alone, without torch."""

from typing import TYPE_CHECKING, Any

from gsbench.analysis.cells import to_frame
from gsbench.analysis.results import load_experiment

if TYPE_CHECKING:
    from gsbench.analysis.frames import judge_frame as judge

__all__ = ["judge", "load_experiment", "to_frame"]


def __getattr__(name: str) -> Any:
    if name == "judge":  # imported at its first use, since SciPy is slow to import
        from gsbench.analysis.frames import judge_frame

        return judge_frame
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
