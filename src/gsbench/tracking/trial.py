"""A trial in a tracker's terms: what its files say, how far that was sent, and the contract of a tracker."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from gsbench.records import Count, Record, read_if_sound
from gsbench.runs import layout
from gsbench.runs.keys import TRAIN, flatten, sha256_of
from gsbench.runs.trial_folder import TrialFolder
from gsbench.runs.trial_record import TrialRecord, read_rows

FILES = (layout.CONFIG, layout.RESULTS, layout.INIT_REPORT, layout.PER_VIEW, layout.EVENTS)
CURVES = {layout.CURVES: "train", layout.EVENTS: "events"}


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


@dataclass(frozen=True)
class TrackedTrial:
    """A trial in ``folder`` with the configuration ``values``, in the terms of a tracker."""

    folder: TrialFolder
    values: dict[str, Any]

    @property
    def arm(self) -> str:
        """Initialiser and densifier."""
        return f"{self.values['init']['name']}-{self.values['densify']['name']}"

    @property
    def label(self) -> str:
        """The run's name: the seed first, since trackers cut names at their end."""
        return f"seed {self.values['seed']} {self.values['scene']['name']} {self.arm}"

    @property
    def path(self) -> str:
        """The trial's folder as seen from the runs folder."""
        return self.folder.path.relative_to(self.folder.runs).as_posix()

    def tags(self) -> dict[str, str]:
        """The tags by which the trial is found."""
        names = {group: self.values[group]["name"] for group in ("scene", "init", "densify")}
        return {"kind": "trial", **names, "seed": str(self.values["seed"]), "folder": self.path}

    def params(self) -> dict[str, str]:
        """The settings that have a value, by their dotted keys; the arm is first in charts."""
        return {"arm": self.arm} | {key: str(value) for key, value in flatten(self.values).items() if str(value)}

    def results_hash(self) -> str | None:
        """The hash of the results, by which a mirror knows whether it shows them; None where there are none."""
        results = self.folder.sound_record()
        return None if results is None else sha256_of(results.to_json())

    def curves(self, logged: dict[str, int]) -> Iterator[tuple[str, int, list[Point]]]:
        """Read each file of curves: its name, its newest iteration, and its points after ``logged[name]``."""
        building = self.folder.building()  # a training in progress writes elsewhere
        sources = [Path(building.folder)] if building.stage == TRAIN.name else []
        for name, prefix in CURVES.items():
            source = next((folder / name for folder in (*sources, self.folder.path) if (folder / name).exists()), None)
            records = [] if source is None else [r for r in read_rows(source) if r["step"] > logged.get(name, 0)]
            if records:
                points = [
                    Point(f"{prefix}/{key}", float(value), int(record["step"]), _seconds(record))
                    for record in records
                    for key, value in record.items()
                    if key != "step"
                ]
                yield name, int(records[-1]["step"]), points

    def summary(self, results: TrialRecord, images: int, with_model: bool) -> Summary:
        """The summary of the finished trial, with ``images`` test views at most, and the model if ``with_model``."""
        step, seconds = results.iterations, results.seconds.get("train", results.iterations / 1000)
        numbers = dict(results.metrics) | {
            key: value
            for key in ("num_gaussians", "num_init_points", "peak_memory_mb")
            if (value := getattr(results, key)) is not None  # not known of renders that another program made
        }
        numbers |= {f"seconds_{key}": value for key, value in results.seconds.items()}
        numbers |= {f"total/{key}": value for key, value in results.events.items()}
        points = [
            Point(key, float(value), int(at), seconds * int(at) / max(1, step))
            for at, measured in results.metrics_at.items()
            for key, value in measured.metrics.items()
        ]
        tags = {"protocol": results.protocol, "raster": results.raster, "commit": results.code.commit or "unknown"}
        names = (*FILES, *([layout.POINT_CLOUD] if with_model else []))
        files = [("", self.folder.path / name) for name in names if (self.folder.path / name).exists()]
        return Summary(
            points=points + [Point(key, float(value), step, seconds) for key, value in numbers.items()],
            tags=tags | {f"hash_{key}": value for key, value in results.hashes.items()},
            pictures={
                f"{kind}/{path.stem}": path
                for kind in (layout.RENDERS, layout.GROUND_TRUTH)
                for path in self.folder.pictures(kind)[:images]
            },
            files=files + [(layout.FIGURES, path) for path in self.folder.pictures(layout.FIGURES)[:images]],
            step=step,
            seconds=seconds,
        )


def _seconds(record: Mapping[str, float]) -> float:
    """The training time of a record, or else a function of its iteration: the same whenever it is read."""
    return float(record.get("seconds", record["step"] / 1000))


@dataclass(frozen=True, kw_only=True)
class MirrorState(Record):
    """State that any sink keeps: ``complete`` is the hash of the results that it shows, ``logged`` the newest iteration
    by file; the rest says which run it is, in the sink's own words.
    """

    complete: str | None = None
    logged: dict[str, Count] = field(default_factory=dict)
    uri: str | None = None
    token: str | None = None
    started: Count | None = None  # ms since 1970
    id: str | None = None

    def __post_init__(self) -> None:
        if self.token is not None and self.started is None:
            raise ValueError("it has a run and no start")


def read_state(file: Path) -> dict[str, Any]:
    """Read the state in ``file``; empty, as if nothing were mirrored yet, where it is absent or damaged."""
    state = read_if_sound(file, MirrorState)
    return {} if state is None else {"complete": None, "logged": {}} | state.to_json()
