"""The contract of a tracker, and TensorBoard and Weights & Biases; MLflow is in `mlflow_sink`."""

import os
import shutil
import uuid
import weakref
from dataclasses import dataclass, field
from typing import Any, Protocol

from gsbench.files import require_no_links
from gsbench.parsing import Count, Record
from gsbench.runs import layout
from gsbench.system.install import require_package
from gsbench.tracking.trial import TrackedTrial, Update


class Run(Record):
    """The run of a trial, and what was sent to it. gsbench keeps it in the trial's folder."""

    token: str | None = None  # gsbench's name of the run, kept before the tracker hears of it
    started: Count = 0  # ms since 1970: a metric's time is this plus the seconds of training
    replaces: str | None = None  # the token of a run with results that are no longer the trial's
    id: str | None = None  # what `Sink.open` returned
    described: bool = False  # its settings and tags were sent
    logged: dict[str, Count] = field(default_factory=dict)  # newest iteration sent, by file
    complete: str | None = None  # hash of the results that were sent; for a sink, any end
    ended: str | None = None  # how a trial without results had ended when that was sent


class Sink(Protocol):
    """One trial in a tracker; a new object is made for each.

    The methods are called in a process beside the sweep; each may raise any error, which harms no
    trial, and is called again later. The process may be killed at any moment, and ends without
    clean-up. So `send` must send at once what it gets, and may get it again.

    Examples:
        Only the last value of each metric is kept:

        >>> from types import SimpleNamespace
        >>> from gsbench.tracking import Scalar, Update
        >>> class Latest:
        ...     def open(self, trial, run):
        ...         self.shown = {}
        ...         return run.token
        ...
        ...     def send(self, update):
        ...         self.shown |= {one.key: one.value for one in update.scalars}

        >>> latest = Latest()
        >>> latest.open(None, SimpleNamespace(token="a"))
        'a'
        >>> latest.send(Update(scalars=[Scalar("loss", 0.2, step=100, seconds=3.0)]))
        >>> latest.shown
        {'loss': 0.2}
    """

    def open(self, trial: TrackedTrial, run: Run) -> str:
        """Begin the run ``run.token``, or continue it; returns its name in the tracker.

        If the name differs from ``run.id``, nothing was sent to it yet, and all is sent. A run that
        ``run.replaces`` may be deleted. If ``run.complete``, the tracker may lack nothing.
        """

    def send(self, update: Update) -> None:
        """Show what is new: first settings and tags, then curves, then the end of the trial."""


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
        weakref.finalize(self, self._writer.close)  # its thread would last as long as the process
        return uuid.uuid4().hex

    def send(self, update: Update) -> None:
        for name, values in (("settings", update.params), ("trial", update.tags)):
            rows = "".join(f"| {key} | {value} |\n" for key, value in values.items())
            if rows:
                self._writer.add_text(name, f"| | |\n|---|---|\n{rows}")
        for scalar in update.scalars:
            time = self._run.started / 1000 + scalar.seconds
            self._writer.add_scalar(scalar.key, scalar.value, scalar.step, time)
        for picture in update.pictures:
            self._writer.add_image(picture.key, picture.pixels, picture.step, dataformats="HWC")
        if update.status:
            self._writer.add_text("status", ": ".join(filter(None, [update.status, update.reason])))
        self._writer.flush()


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
        for place in ("wandb", ".wandb"):  # where its client writes
            require_no_links(trial.folder.runs, folder / place)
        folder.mkdir(exist_ok=True)
        self._root, scene = trial.folder.path, trial.values["scene"]["name"]
        if wandb.run is not None:  # of a trial that runs: `init` would return it
            wandb.run.finish()
        self._run: Any = wandb.init(
            project=trial.values["name"],
            name=trial.label,
            id=run.token,
            resume="allow",
            group=f"{scene} {trial.arm}",
            tags=[scene, trial.arm],
            dir=str(folder),
            settings=wandb.Settings(silent=True, console="off"),
        )
        self._run.define_metric("*", step_metric=STEP)
        return name

    def send(self, update: Update) -> None:
        import wandb

        self._run.config.update({**update.params, **update.tags}, allow_val_change=True)
        by_step: dict[int, dict[str, float]] = {}
        for scalar in update.scalars:
            by_step.setdefault(scalar.step, {})[scalar.key] = scalar.value
        for step, values in by_step.items():
            self._run.log({STEP: step, **values})
        for picture in update.pictures:
            self._run.log({STEP: picture.step, picture.key: wandb.Image(picture.pixels)})
        for path in update.files.values():
            self._run.save(str(path), base_path=str(self._root), policy="now")
        if update.status in ("FAILED", "KILLED"):
            self._run.summary["error" if update.reason else "status"] = (
                update.reason or update.status
            )
        if update.status:
            self._run.finish(int(update.status != "FINISHED"))
