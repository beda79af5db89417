"""Contract of a tracker to which trials are mirrored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

DEFAULT = "mlflow"
NAMES = {DEFAULT: "MLflow", "tensorboard": "TensorBoard", "wandb": "Weights & Biases"}


@dataclass(frozen=True)
class Point:
    """One number of a trial: its name, the iteration, and the seconds of training until then."""

    key: str
    value: float
    step: int
    seconds: float


@dataclass(frozen=True)
class Summary:
    """Summary of a complete trial: final numbers, tags, pictures of the test views by name, other files by
    folder ("" for none).
    """

    points: Sequence[Point]
    tags: dict[str, str]
    pictures: dict[str, Path]
    files: Sequence[tuple[str, Path]]
    step: int
    seconds: float


class Sink(Protocol):
    """One trial in a tracker. Each method may raise whatever the tracker's client raises.

    It is closed by no one: its process ends without tearing anything down, so each method sends what it is given.

    Examples:
        One that prints:

        >>> class Printed:
        ...     state_file = "printed.json"
        ...
        ...     def open(self, state, results):
        ...         return state
        ...
        ...     def log(self, points):
        ...         for point in points:
        ...             print(f"{point.step}: {point.key} {point.value}")
        ...
        ...     def complete(self, summary):
        ...         self.log(summary.points)
        ...
        ...     def stop(self, status, reason):
        ...         print(status, reason)

        >>> sink: Sink = Printed()
        >>> sink.log([Point("loss", 0.5, step=100, seconds=1.0)])
        100: loss 0.5
    """

    state_file: str  # in the trial's folder: what `open` returned, "complete" and "logged" kept by `TrackedTrial`

    def open(self, state: dict[str, Any], results: str | None) -> dict[str, Any]:
        """Begin the trial's run, or go on with the one that ``state`` tells of; returns the state to keep.

        ``results`` is the hash of the trial's results, if there are any: where ``state["complete"]`` is another, the
        run shows results that are no longer the trial's, and is replaced.
        """

    def log(self, points: Sequence[Point]) -> None:
        """Take numbers; some may be repetitions, where a process was killed after it had sent them."""

    def complete(self, summary: Summary) -> None:
        """Show what came out, and that the trial is done."""

    def stop(self, status: str, reason: str | None) -> None:
        """Show that the trial ended without results: ``status`` KILLED, or FAILED for a ``reason``."""


def name_of(options: dict[str, Any]) -> str:
    """The tracker's name, for people."""
    return NAMES[options.get("sink", DEFAULT)]
