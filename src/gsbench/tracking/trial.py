"""A trial in a tracker's terms: what its files say, and how far that was sent."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gsbench.records import Count, Record, read_if_sound
from gsbench.runs import layout
from gsbench.runs.hashing import flatten, sha256_of
from gsbench.runs.rows import read_rows
from gsbench.runs.stages import TRAIN
from gsbench.runs.trial_folder import TrialFolder
from gsbench.runs.trial_record import TrialRecord
from gsbench.tracking.sink import Point, Summary

FILES = (layout.CONFIG, layout.RESULTS, layout.INIT_REPORT, layout.PER_VIEW, layout.EVENTS)
CURVES = {layout.CURVES: "train", layout.EVENTS: "events"}


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
        tags = {"protocol": results.protocol, "raster": results.raster}
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
