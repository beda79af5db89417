"""Tables, statistics and reports. They are made from result files alone, without torch."""

from typing import TYPE_CHECKING, Any

from gsbench.analysis.cells import to_frame
from gsbench.analysis.results import load_experiment

if TYPE_CHECKING:
    from gsbench.analysis.frames import judge

__all__ = ["judge", "load_experiment", "to_frame"]


def __getattr__(name: str) -> Any:
    """`judge` is imported when it is asked for, since SciPy is slow to import."""
    if name == "judge":
        from gsbench.analysis.frames import judge

        return judge
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
