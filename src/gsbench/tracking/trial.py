"""A trial in a tracker's terms: names, curves, results and pictures, read from its files."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from gsbench.eval.facts import find_metric
from gsbench.runs import layout
from gsbench.runs.commands import read_history
from gsbench.runs.configuration import flatten, sha256_of
from gsbench.runs.keys import TRAIN
from gsbench.runs.trial_folder import TrialFolder
from gsbench.runs.trial_record import TrialRecord, read_rows
from gsbench.scene.images import read_image
from gsbench.words import command

# characters that MLflow refuses in a picture's name
NOT_IN_A_KEY = re.compile(r"[^a-zA-Z0-9_\-. ]")
Array = NDArray[np.uint8]
FILES = (layout.CONFIG, layout.RESULTS, layout.INIT_REPORT, layout.PER_VIEW, layout.EVENTS)
# Trackers sort names and show a chart for each, so only what people look at is sent, results first.
EVAL = "eval"
CURVES: dict[str, dict[str, str]] = {  # by file: key in it -> name in the tracker
    layout.CURVES: {
        "loss": "train/loss",
        "l1": "train/l1",
        "ssim": "train/ssim",
        "num_gaussians": "train/gaussians",
    },
    layout.EVENTS: {
        key: f"train/densify/{key}"
        for key in (
            "cloned",
            "split_gradient",
            "split_volume",
            "pruned_opacity",
            "pruned_size",
            "blocked_by_cap",
        )
    },
}


PICTURE_KINDS = ("1 render", "2 photograph", "3 error")  # of a test view, numbered for their order


def picture_key(view: str, kind: str) -> str:
    """The name of a picture of a test view, with characters that every tracker takes."""
    return f"{NOT_IN_A_KEY.sub('_', view)}/{kind}"


def eval_name(key: str) -> str:
    """The name of a metric of the test views, with its unit: ``eval/psnr_dB``."""
    facts = find_metric(key)
    unit = facts.unit.replace("/", "_per_") if facts else ""
    return f"{EVAL}/{key}_{unit}" if unit else f"{EVAL}/{key}"


def numbers_of(results: TrialRecord) -> dict[str, float]:
    """The numbers at the end of a trial by their names in a tracker, results first."""
    numbers: dict[str, float | None] = {
        eval_name(key): value for key, value in results.metrics.items()
    }
    # None: unknown, for renders of another program
    numbers[f"{EVAL}/gaussians"] = results.num_gaussians
    numbers[f"{EVAL}/init_points"] = results.num_init_points
    numbers[f"{EVAL}/peak_memory_MB"] = results.peak_memory_mb
    if "train" in results.seconds:
        numbers[f"{EVAL}/minutes"] = results.seconds["train"] / 60
    return {name: value for name, value in numbers.items() if value is not None}


@dataclass(frozen=True)
class Scalar:
    """One number of a trial: its name, value, iteration, and the seconds of training until then."""

    key: str
    value: float
    step: int
    seconds: float


@dataclass(frozen=True)
class Picture:
    """A picture of a test view: ``pixels`` [H, W, 3] uint8, shown at an iteration and a time."""

    key: str
    pixels: Array
    step: int
    seconds: float


@dataclass(frozen=True)
class Update:
    """The part of a trial that a tracker is to show from now on, beside what it shows.

    Settings and tags are texts by their names. ``status`` says that the trial has ended, ``reason``
    why it failed.
    """

    params: Mapping[str, str] = field(default_factory=dict)
    tags: Mapping[str, str] = field(default_factory=dict)
    scalars: Sequence[Scalar] = ()
    files: Mapping[str, Path] = field(default_factory=dict)  # by their paths in the tracker
    pictures: Sequence[Picture] = ()
    status: Literal["FINISHED", "FAILED", "KILLED"] | None = None
    reason: str | None = None


@dataclass(frozen=True)
class TrackedTrial:
    """A trial in ``folder`` with the configuration ``values``, in the terms of a tracker."""

    folder: TrialFolder
    values: dict[str, Any]

    @property
    def arm(self) -> str:
        """The name of the trial's arm.

        The densifier is compared most often. It comes first, since trackers cut long names at the
        end.
        """
        return f"{self.values['densify']['name']} · {self.values['init']['name']}"

    @property
    def label(self) -> str:
        """The run's name: densifier, scene and seed."""
        return (
            f"{self.values['densify']['name']} · {self.values['scene']['name']} · "
            f"s{self.values['seed']}"
        )

    @property
    def path(self) -> str:
        """The trial's folder, relative to the runs folder."""
        return self.folder.path.relative_to(self.folder.runs).as_posix()

    def tags(self) -> dict[str, str]:
        """The tags by which the trial is found."""
        names = {group: self.values[group]["name"] for group in ("scene", "init", "densify")}
        return {"kind": "trial", **names, "seed": str(self.values["seed"]), "folder": self.path}

    def params(self) -> dict[str, str]:
        """The settings that have a value, by their dotted keys. The arm comes first, for charts."""
        return {"arm": self.arm} | {
            key: str(value) for key, value in flatten(self.values).items() if str(value)
        }

    def results_hash(self) -> str | None:
        """The hash of the results, by which a mirror knows whether it shows them, or None."""
        results = self.folder.sound_record()
        return None if results is None else sha256_of(results.to_json())

    def ending(self) -> str:
        """The end of a trial without results: when it failed, or where it was stopped."""
        if self.folder.has_failed():
            return f"failed at {self.folder.failure().time}"
        return "stopped in {} at {}".format(*self.folder.stage_and_step())

    def curves(
        self, logged: Mapping[str, int], live: bool
    ) -> Iterator[tuple[str, int, list[Scalar]]]:
        """Yield name, newest iteration and new scalars of each file of curves with new records.

        Records after the iteration ``logged[name]`` are new. ``live`` says that the trial runs.
        """
        # A training in progress writes to its own folder in the store. The trial's folder has the
        # curves of the last training that ended, perhaps of an earlier command.
        building = self.folder.building()
        places = [Path(building.folder)] if building.stage == TRAIN.name else []
        places += [] if live else [self.folder.path]
        for name, names in CURVES.items():
            source = next((file for place in places if (file := place / name).exists()), None)
            rows = [] if source is None else read_rows(source)
            if records := [row for row in rows if row["step"] > logged.get(name, 0)]:
                scalars = []
                for record in records:
                    step = int(record["step"])
                    # without a recorded time, one that each reading gives alike
                    seconds = float(record.get("seconds", step / 1000))
                    scalars += [
                        Scalar(names[key], float(value), step, seconds)
                        for key, value in record.items()
                        if key in names
                    ]
                yield name, int(records[-1]["step"]), scalars

    def summary(self, results: TrialRecord, images: int, with_model: bool) -> Update:
        """The finished trial with at most ``images`` test views, and its model ``with_model``."""
        step, seconds = results.iterations, results.seconds.get("train", results.iterations / 1000)
        scalars = []
        for at, measured in results.metrics_at.items():
            then = seconds * int(at) / max(1, step)
            for key, value in measured.metrics.items():
                scalars.append(Scalar(eval_name(key), float(value), int(at), then))
        numbers = numbers_of(results).items()
        scalars += [Scalar(key, float(value), step, seconds) for key, value in numbers]
        tags = {
            "protocol": results.protocol,
            "raster": results.raster,
            "commit": results.code.commit or "unknown",
        }
        if planned := read_history(self.folder.home).planned.get(self.folder.path):
            tags["command"] = command(*planned.words)  # that repeats it
        tags |= {f"hash_{key}": value for key, value in results.hashes.items()}
        names = (*FILES, layout.POINT_CLOUD) if with_model else FILES
        files = self.files(names)
        pictures = [
            Picture(key, pixels, step, seconds) for key, pixels in self._pictures(images).items()
        ]
        return Update(tags=tags, scalars=scalars, files=files, pictures=pictures, status="FINISHED")

    def files(self, names: Sequence[str]) -> dict[str, Path]:
        """The files among ``names`` that the trial's folder has."""
        paths = {name: self.folder.path / name for name in names}
        return {name: path for name, path in paths.items() if path.exists()}

    def _pictures(self, count: int) -> dict[str, Array]:
        """Render, photograph and absolute error of ``count`` test views, by `picture_key`."""
        rendered, photographed, wrong = PICTURE_KINDS
        pictures: dict[str, Array] = {}
        for path in self.folder.pictures(layout.RENDERS)[:count]:
            render = read_image(path)
            pictures[picture_key(path.stem, rendered)] = render
            photograph = self.folder.path / layout.GROUND_TRUTH / path.name
            if not photograph.exists():
                continue
            truth = read_image(photograph)
            pictures[picture_key(path.stem, photographed)] = truth
            if truth.shape == render.shape:
                error = np.abs(render.astype(np.int16) - truth.astype(np.int16))
                pictures[picture_key(path.stem, wrong)] = error.astype(np.uint8)
        return pictures
