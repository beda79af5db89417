"""A trial in a tracker's terms, a tracker's contract, and TensorBoard and Weights & Biases."""

import os
import re
import shlex
import shutil
import time
import uuid
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gsbench.eval.facts import find_metric
from gsbench.files import require_no_links
from gsbench.parsing import Count, Record, read_if_sound
from gsbench.runs import layout
from gsbench.runs.keys import TRAIN
from gsbench.runs.nested import flatten, sha256_of
from gsbench.runs.trial_folder import TrialFolder
from gsbench.runs.trial_record import TrialRecord, read_rows

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


def arm_name(densify: str, init: str) -> str:
    """The name of an arm.

    The densifier is compared most often. It comes first, since trackers cut long names at the end.
    """
    return f"{densify} · {init}"


def eval_name(key: str) -> str:
    """The name of a metric of the test views, with its unit: ``eval/psnr_dB``."""
    facts = find_metric(key)
    unit = facts.unit.replace("/", "_per_") if facts else ""
    return f"{EVAL}/{key}_{unit}" if unit else f"{EVAL}/{key}"


@dataclass(frozen=True)
class Scalar:
    """One number of a trial: its name, value, iteration, and the seconds of training until then."""

    key: str
    value: float
    step: int
    seconds: float


@dataclass(frozen=True)
class Summary:
    """The parts of a finished trial that a tracker shows; ``note`` is in Markdown."""

    note: str
    scalars: Sequence[Scalar]
    tags: dict[str, str]
    pictures: dict[str, Array]  # of the test views, by name: [H, W, 3] uint8
    files: Sequence[tuple[str, Path]]  # (folder in the tracker, "" for none; file)
    step: int
    seconds: float


@dataclass(frozen=True, kw_only=True)
class MirrorState(Record):
    """The state of a mirror, kept in the trial's folder.

    `TrackerRun` keeps the first two fields; a sink uses the others to find its run again.
    """

    complete: str | None = None  # hash of the results that the run shows
    logged: dict[str, Count] = field(default_factory=dict)  # newest iteration sent, by file
    uri: str | None = None
    token: str | None = None
    started: Count = 0  # ms since 1970
    id: str | None = None

    def shows(self, results: str | None) -> bool:
        """Return whether the run shows the results with this hash; False without results."""
        return results is not None and self.complete == results


class Sink(Protocol):
    """One trial in a tracker. Each method may raise any error of the tracker's client.

    A sink is never closed, since its process ends without clean-up. So each method must send at
    once what it gets.

    Examples:
        A sink that prints:

        >>> class Printed:
        ...     name, state_file = "a printer", "printed.json"
        ...
        ...     def open(self, state, results):
        ...         return state
        ...
        ...     def log(self, scalars):
        ...         for scalar in scalars:
        ...             print(f"{scalar.step}: {scalar.key} {scalar.value}")
        ...
        ...     def complete(self, summary):
        ...         self.log(summary.scalars)
        ...
        ...     def stop(self, status, reason):
        ...         print(status, reason)

        >>> sink: Sink = Printed()
        >>> sink.log([Scalar("loss", 0.5, step=100, seconds=1.0)])
        100: loss 0.5
    """

    name: str  # the tracker's, in messages
    state_file: str  # in the trial's folder, for the state that `open` returns

    def open(self, state: MirrorState, results: str | None) -> MirrorState:
        """Begin a run for the trial, or continue that of ``state``; returns the state to keep.

        ``results`` is the hash of the trial's results, None without results. If ``state.complete``
        is another hash, the run shows results that are no longer the trial's, and is replaced.
        """

    def log(self, scalars: Sequence[Scalar]) -> None:
        """Log numbers.

        Some may have been sent before, by a process that was killed before it could record that.
        """

    def complete(self, summary: Summary) -> None:
        """Show the results, and that the trial is done."""

    def stop(self, status: str, reason: str | None) -> None:
        """Show that the trial ended without results: ``status`` KILLED, or FAILED (``reason``)."""


@dataclass(frozen=True)
class TrackedTrial:
    """A trial in ``folder`` with the configuration ``values``, in the terms of a tracker."""

    folder: TrialFolder
    values: dict[str, Any]

    @property
    def arm(self) -> str:
        """The name of the trial's arm."""
        return arm_name(self.values["densify"]["name"], self.values["init"]["name"])

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

    def curves(self, logged: dict[str, int]) -> Iterator[tuple[str, int, list[Scalar]]]:
        """Yield name, newest iteration and new scalars of each file of curves with new records.

        Records after the iteration ``logged[name]`` are new.
        """
        # a training in progress writes to its own folder in the store
        building = self.folder.building()
        sources = [Path(building.folder)] if building.stage == TRAIN.name else []
        for name, names in CURVES.items():
            files = (folder / name for folder in (*sources, self.folder.path))
            source = next((file for file in files if file.exists()), None)
            rows = [] if source is None else read_rows(source)
            records = [row for row in rows if row["step"] > logged.get(name, 0)]
            scalars: list[Scalar] = []
            for record in records:
                step, seconds = int(record["step"]), _seconds(record)
                known = [key for key in record if key in names]
                scalars += [Scalar(names[key], float(record[key]), step, seconds) for key in known]
            if records:
                yield name, int(records[-1]["step"]), scalars

    def summary(self, results: TrialRecord, images: int, with_model: bool) -> Summary:
        """The finished trial with at most ``images`` test views, and its model ``with_model``."""
        step, seconds = results.iterations, results.seconds.get("train", results.iterations / 1000)
        numbers = {eval_name(key): value for key, value in results.metrics.items()}
        counts = {
            "gaussians": results.num_gaussians,
            "init_points": results.num_init_points,
            "peak_memory_MB": results.peak_memory_mb,
        }
        # None: unknown, for renders of another program
        numbers |= {f"{EVAL}/{key}": value for key, value in counts.items() if value is not None}
        if "train" in results.seconds:
            numbers[f"{EVAL}/minutes"] = results.seconds["train"] / 60
        scalars = []
        for at, measured in results.metrics_at.items():
            then = seconds * int(at) / max(1, step)
            for key, value in measured.metrics.items():
                scalars.append(Scalar(eval_name(key), float(value), int(at), then))
        scalars += [Scalar(key, float(value), step, seconds) for key, value in numbers.items()]
        tags = {
            "protocol": results.protocol,
            "raster": results.raster,
            "commit": results.code.commit or "unknown",
        }
        tags |= {f"hash_{key}": value for key, value in results.hashes.items()}
        names = (*FILES, layout.POINT_CLOUD) if with_model else FILES
        paths = [self.folder.path / name for name in names]
        files = [("", path) for path in paths if path.exists()]
        figures = self.folder.pictures(layout.FIGURES)[:images]
        return Summary(
            note=self._note(results),
            scalars=scalars,
            tags=tags,
            pictures=self._pictures(images),
            files=files + [(layout.FIGURES, path) for path in figures],
            step=step,
            seconds=seconds,
        )

    def _note(self, results: TrialRecord) -> str:
        """The results in one line, the folder, and the command that repeats it, in Markdown."""
        shown = [(find_metric(key), key, value) for key, value in results.metrics.items()]
        texts = [f"{facts.name if facts else key} {value:.4g}" for facts, key, value in shown]
        if results.num_gaussians is not None:
            texts.append(f"{results.num_gaussians:,} Gaussians")
        lines = [
            f"{', '.join(texts)} after {results.iterations:,} iterations.",
            f"Folder: `{self.path}`",
        ]
        plan = read_if_sound(self.folder.home / layout.PLAN, _Plan)
        place = self.folder.path.relative_to(self.folder.home).as_posix()
        if plan and (planned := plan.trials.get(place)):
            lines.append(f"Again: `{shlex.join(['gsbench', *planned.overrides])}`")
        return "\n\n".join(lines)

    def _pictures(self, count: int) -> dict[str, Array]:
        """Render, photograph and absolute error of ``count`` test views, by `picture_key`."""
        rendered, photographed, wrong = PICTURE_KINDS
        pictures: dict[str, Array] = {}
        for path in self.folder.pictures(layout.RENDERS)[:count]:
            render = _read_picture(path)
            pictures[picture_key(path.stem, rendered)] = render
            photograph = self.folder.path / layout.GROUND_TRUTH / path.name
            if not photograph.exists():
                continue
            truth = _read_picture(photograph)
            pictures[picture_key(path.stem, photographed)] = truth
            if truth.shape == render.shape:
                error = np.abs(render.astype(np.int16) - truth.astype(np.int16))
                pictures[picture_key(path.stem, wrong)] = error.astype(np.uint8)
        return pictures


@dataclass(frozen=True, kw_only=True)
class _Planned(Record):
    """The part of a planned trial that is shown: the words of its command."""

    overrides: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class _Plan(Record):
    """The part of an experiment's plan that is shown: its trials by their folders."""

    trials: dict[str, _Planned]


def _read_picture(path: Path) -> Array:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


def _seconds(record: Mapping[str, float]) -> float:
    """The training time of a record.

    For a record without a time it is computed from the iteration, so that each reading agrees.
    """
    return float(record.get("seconds", record["step"] / 1000))


# ---- TensorBoard: event files in ``tensorboard/`` of the runs folder


class TensorBoardSink:
    """The event files of one trial. They cannot be edited, so a continued trial starts anew."""

    name, state_file = "TensorBoard", "tensorboard.json"

    def __init__(self, options: dict[str, Any], trial: TrackedTrial) -> None:
        self._trial = trial
        self._folder = trial.folder.runs / layout.TENSORBOARD / trial.path
        self._started = time.time()
        self._writer: Any = None

    def open(self, state: MirrorState, results: str | None) -> MirrorState:
        """Open the run as `gsbench.tracking.sinks.Sink` says."""
        if self._folder.is_dir() and state.shows(results):
            return state
        from torch.utils.tensorboard import SummaryWriter

        require_no_links(self._trial.folder.runs, self._folder)
        shutil.rmtree(self._folder, ignore_errors=True)
        self._writer = SummaryWriter(str(self._folder))
        for name, values in (("settings", self._trial.params()), ("trial", self._trial.tags())):
            table = "".join(f"| {key} | {value} |\n" for key, value in values.items())
            self._writer.add_text(name, f"| | |\n|---|---|\n{table}")
        return MirrorState()

    def log(self, scalars: Sequence[Scalar]) -> None:
        """Write numbers, and flush them to the file."""
        for scalar in scalars:
            self._writer.add_scalar(
                scalar.key, scalar.value, scalar.step, self._started + scalar.seconds
            )
        self._writer.flush()

    def complete(self, summary: Summary) -> None:
        """Write the final numbers and the pictures of the test views."""
        self.log(summary.scalars)
        for name, picture in summary.pictures.items():
            self._writer.add_image(name, picture, summary.step, dataformats="HWC")
        self._writer.add_text("note", summary.note, summary.step)
        self._writer.add_text("status", "FINISHED", summary.step)
        self._writer.flush()

    def stop(self, status: str, reason: str | None) -> None:
        """Write why the trial ended."""
        self._writer.add_text("status", status if reason is None else f"{status}: {reason}")
        self._writer.flush()


# ---- Weights & Biases: ``tracking.uri`` is its server, else WANDB_BASE_URL and WANDB_MODE decide

# gsbench's axis: W&B's step must only grow, and two files of curves are read one after the other
STEP = "iteration"


class WandbSink:
    """The W&B run of one trial; the project is the experiment, the group is scene and arm."""

    name, state_file = "Weights & Biases", "wandb.json"

    def __init__(self, options: dict[str, Any], trial: TrackedTrial) -> None:
        self._trial = trial
        if options["uri"]:
            os.environ["WANDB_BASE_URL"] = options["uri"]
        self._run: Any = None

    def open(self, state: MirrorState, results: str | None) -> MirrorState:
        """Open the run (see `gsbench.tracking.sinks.Sink`).

        A run with earlier results stays beside the new one.
        """
        if state.shows(results):
            return state
        if state.complete is not None or state.id is None:
            state = MirrorState(id=uuid.uuid4().hex[:8])
        import wandb

        trial = self._trial
        folder = trial.folder.runs / layout.WANDB
        require_no_links(trial.folder.runs, folder)
        folder.mkdir(exist_ok=True)
        self._run = wandb.init(
            project=trial.values["name"],
            name=trial.label,
            id=state.id,
            resume="allow",
            group=f"{trial.values['scene']['name']} {trial.arm}",
            config=trial.params(),
            tags=[trial.values["scene"]["name"], trial.arm],
            dir=str(folder),
            settings=wandb.Settings(silent=True, console="off"),
        )
        self._run.define_metric("*", step_metric=STEP)
        return state

    def log(self, scalars: Sequence[Scalar]) -> None:
        """Log numbers, together for each iteration."""
        by_step: dict[int, dict[str, float]] = {}
        for scalar in scalars:
            by_step.setdefault(scalar.step, {})[scalar.key] = scalar.value
        for step, values in by_step.items():
            self._run.log({STEP: step, **values})

    def complete(self, summary: Summary) -> None:
        """Log the final numbers, pictures and files, and finish the run."""
        import wandb

        self.log(summary.scalars)
        pictures = {name: wandb.Image(picture) for name, picture in summary.pictures.items()}
        if pictures:
            self._run.log({STEP: summary.step, **pictures})
        final = [scalar for scalar in summary.scalars if scalar.step == summary.step]
        self._run.summary.update({scalar.key: scalar.value for scalar in final})
        self._run.config.update(summary.tags, allow_val_change=True)
        self._run.notes = summary.note
        for _, path in summary.files:
            self._run.save(str(path), base_path=str(self._trial.folder.path), policy="now")
        self._run.finish(0)

    def stop(self, status: str, reason: str | None) -> None:
        """Finish the run as failed, with the reason or the status."""
        self._run.summary["error" if reason else "status"] = reason or status
        self._run.finish(1)
