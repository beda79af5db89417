"""A trial as a run of Weights & Biases. ``tracking.uri`` is its server, else WANDB_BASE_URL and WANDB_MODE decide."""

import os
import uuid
from collections.abc import Sequence
from typing import Any

from gsbench.files import require_no_links
from gsbench.runs.layout import WANDB
from gsbench.tracking.trial import Scalar, Summary, TrackedTrial

STEP = "iteration"  # our own axis: W&B's step must only grow, and the two files of curves are read one after the other


class WandbSink:
    """The W&B run of one trial; the project is the experiment, the group is scene and arm."""

    state_file = "wandb.json"

    def __init__(self, options: dict[str, Any], trial: TrackedTrial) -> None:
        self._trial = trial
        if options["uri"]:
            os.environ["WANDB_BASE_URL"] = options["uri"]
        self._run: Any = None

    def open(self, state: dict[str, Any], results: str | None) -> dict[str, Any]:
        """Open the run (see `gsbench.tracking.trial.Sink`). A run with earlier results stays beside the new one."""
        if state.get("complete") is not None:
            if state["complete"] == results:
                return state
            state = {}
        state = state or {"id": uuid.uuid4().hex[:8], "complete": None, "logged": {}}
        import wandb

        trial = self._trial
        folder = trial.folder.runs / WANDB
        require_no_links(trial.folder.runs, folder)
        folder.mkdir(exist_ok=True)
        self._run = wandb.init(
            project=trial.values["name"],
            name=trial.label,
            id=state["id"],
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
        pictures = {name: wandb.Image(str(path)) for name, path in summary.pictures.items()}
        if pictures:
            self._run.log({STEP: summary.step, **pictures})
        final = {scalar.key: scalar.value for scalar in summary.scalars if scalar.step == summary.step}
        self._run.summary.update(final)
        self._run.config.update(summary.tags, allow_val_change=True)
        for _, path in summary.files:
            self._run.save(str(path), base_path=str(self._trial.folder.path), policy="now")
        self._run.finish(0)

    def stop(self, status: str, reason: str | None) -> None:
        """Finish the run as failed, with the reason or the status."""
        self._run.summary["error" if reason else "status"] = reason or status
        self._run.finish(1)
