"""The contract of a tracker, and TensorBoard and Weights & Biases; MLflow is in `mlflow_sink`."""

import os
import shutil
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

from gsbench.files import require_no_links
from gsbench.parsing import Count, Record
from gsbench.runs import layout
from gsbench.system.install import require_package
from gsbench.tracking.trial import NOTE, Picture, Scalar, TrackedTrial

Status = Literal["FINISHED", "FAILED", "KILLED"]


class Run(Record):
    """The run of a trial, and what was sent to it. gsbench keeps it in the trial's folder."""

    token: str | None = None  # gsbench's name of the run, kept before the tracker hears of it
    started: Count = 0  # ms since 1970: a metric's time is this plus the seconds of training
    replaces: str | None = None  # the token of a run with results that are no longer the trial's
    id: str | None = None  # what `Sink.open` returned
    described: bool = False  # its settings and tags were sent
    logged: dict[str, Count] = field(default_factory=dict)  # newest iteration sent, by file
    complete: str | None = None  # hash of the results that were sent
    ended: str | None = None  # how a trial without results had ended when that was sent


class Sink(Protocol):
    """One trial in a tracker; a new object is made for each.

    The methods are called in a process of their own, in the order below; each may raise any error,
    which ends the mirroring and harms no trial. The process may be killed at any moment, and ends
    without clean-up. So each method must send at once what it gets, and may get it again.

    Examples:
        Only the last value of each metric is kept:

        >>> from types import SimpleNamespace
        >>> class Latest:
        ...     def open(self, trial, run):
        ...         self.shown = {}
        ...         return run.token
        ...
        ...     def metrics(self, scalars):
        ...         self.shown |= {one.key: one.value for one in scalars}
        ...
        ...     def params(self, values): ...
        ...     def tags(self, values): ...
        ...     def artifacts(self, files, pictures): ...
        ...     def close(self, status, reason): ...

        >>> latest = Latest()
        >>> latest.open(None, SimpleNamespace(token="a"))
        'a'
        >>> latest.metrics([SimpleNamespace(key="loss", value=0.2, step=100)])
        >>> latest.shown
        {'loss': 0.2}
    """

    def open(self, trial: TrackedTrial, run: Run) -> str:
        """Begin the run ``run.token``, or continue it; returns its name in the tracker.

        If the name differs from ``run.id``, nothing was sent to it yet, and all is sent. A run that
        ``run.replaces`` may be deleted. If ``run.complete``, the tracker may lack nothing.
        """

    def params(self, values: Mapping[str, str]) -> None:
        """Show the trial's settings."""

    def tags(self, values: Mapping[str, str]) -> None:
        """Show texts by which the trial is found; `NOTE` describes it."""

    def metrics(self, scalars: Sequence[Scalar]) -> None:
        """Log numbers."""

    def artifacts(self, files: Mapping[str, Path], pictures: Sequence[Picture]) -> None:
        """Keep files, by their paths in the tracker, and show pictures of test views."""

    def close(self, status: Status, reason: str | None) -> None:
        """Show that the trial has ended; ``reason`` is that of a failure."""


class TensorBoard:
    """The event files of a trial. They cannot be edited, so a continued trial starts anew."""

    def __init__(self) -> None:
        require_package("tensorboard", "tensorboard", "tracking=tensorboard")

    def open(self, trial: TrackedTrial, run: Run) -> str:
        folder = trial.folder.runs / layout.TENSORBOARD / trial.path
        if run.id is not None and run.complete and folder.is_dir():
            return run.id
        from torch.utils.tensorboard import SummaryWriter

        require_no_links(trial.folder.runs, folder)
        shutil.rmtree(folder, ignore_errors=True)
        self._writer, self._run = SummaryWriter(str(folder)), run
        return uuid.uuid4().hex

    def params(self, values: Mapping[str, str]) -> None:
        self._table("settings", values)

    def tags(self, values: Mapping[str, str]) -> None:
        self._table("trial", values)

    def metrics(self, scalars: Sequence[Scalar]) -> None:
        for scalar in scalars:
            time = self._run.started / 1000 + scalar.seconds
            self._writer.add_scalar(scalar.key, scalar.value, scalar.step, time)
        self._writer.flush()

    def artifacts(self, files: Mapping[str, Path], pictures: Sequence[Picture]) -> None:
        for picture in pictures:
            self._writer.add_image(picture.key, picture.pixels, picture.step, dataformats="HWC")
        self._writer.flush()

    def close(self, status: Status, reason: str | None) -> None:
        self._writer.add_text("status", status if reason is None else f"{status}: {reason}")
        self._writer.flush()

    def _table(self, name: str, values: Mapping[str, str]) -> None:
        rows = "".join(f"| {key} | {value} |\n" for key, value in values.items())
        self._writer.add_text(name, f"| | |\n|---|---|\n{rows}")


# gsbench's axis: W&B's step must only grow, and two files of curves are read one after the other
STEP = "iteration"


@dataclass
class WandB:
    """The W&B run of a trial; the project is the experiment, the group is scene and arm.

    ``uri`` is the server, else WANDB_BASE_URL and WANDB_MODE decide. A run with earlier results
    stays beside the new one.
    """

    uri: str | None = None

    def __post_init__(self) -> None:
        require_package("wandb", "wandb", "tracking=wandb")

    def open(self, trial: TrackedTrial, run: Run) -> str:
        if self.uri:
            os.environ["WANDB_BASE_URL"] = self.uri
        name = f"{os.environ.get('WANDB_BASE_URL', '')}/{run.token}"
        if run.complete:
            return run.id or name
        import wandb

        folder = trial.folder.runs / layout.WANDB
        for name in ("wandb", ".wandb"):  # where its client writes
            require_no_links(trial.folder.runs, folder / name)
        folder.mkdir(exist_ok=True)
        self._root = trial.folder.path
        self._run: Any = wandb.init(
            project=trial.values["name"],
            name=trial.label,
            id=run.token,
            resume="allow",
            group=f"{trial.values['scene']['name']} {trial.arm}",
            tags=[trial.values["scene"]["name"], trial.arm],
            dir=str(folder),
            settings=wandb.Settings(silent=True, console="off"),
        )
        self._run.define_metric("*", step_metric=STEP)
        return name

    def params(self, values: Mapping[str, str]) -> None:
        self._run.config.update(dict(values), allow_val_change=True)

    def tags(self, values: Mapping[str, str]) -> None:
        self._run.notes = values.get(NOTE, self._run.notes)
        self.params({key: value for key, value in values.items() if key != NOTE})

    def metrics(self, scalars: Sequence[Scalar]) -> None:
        by_step: dict[int, dict[str, float]] = {}
        for scalar in scalars:
            by_step.setdefault(scalar.step, {})[scalar.key] = scalar.value
        for step, values in by_step.items():
            self._run.log({STEP: step, **values})

    def artifacts(self, files: Mapping[str, Path], pictures: Sequence[Picture]) -> None:
        import wandb

        for picture in pictures:
            self._run.log({STEP: picture.step, picture.key: wandb.Image(picture.pixels)})
        for path in files.values():
            self._run.save(str(path), base_path=str(self._root), policy="now")

    def close(self, status: Status, reason: str | None) -> None:
        if status != "FINISHED":
            self._run.summary["error" if reason else "status"] = reason or status
        self._run.finish(int(status != "FINISHED"))
