"""A tracker; docs/hydra.md says how to run it."""

import json
import uuid
from dataclasses import dataclass


@dataclass
class Kept:
    """Keeps each trial in a JSON file."""

    folder: str = "kept"

    def open(self, trial, run):
        self.file = trial.folder.home / self.folder / f"{run.token}.json"
        self.shown = {"name": trial.label, "id": uuid.uuid4().hex}
        if self.file.exists():  # continue
            self.shown = json.loads(self.file.read_text())
        if run.replaces:  # a run with results that are no longer the trial's
            self.file.with_stem(run.replaces).unlink(missing_ok=True)
        return self.shown["id"]  # if it is new, everything is sent (again)

    def send(self, update):
        self.keep("params", update.params)
        self.keep("tags", update.tags)
        self.keep("metrics", {f"{one.key} {one.step}": one.value for one in update.scalars})
        self.keep("files", {name: str(path) for name, path in update.files.items()})
        self.keep("pictures", {one.key: list(one.pixels.shape) for one in update.pictures})
        if update.status:
            self.keep("end", {"status": update.status, "reason": update.reason})

    def keep(self, part, values):
        self.shown[part] = self.shown.get(part, {}) | dict(values)
        self.file.parent.mkdir(exist_ok=True)
        new = self.file.with_suffix(".new")
        new.write_text(json.dumps(self.shown))
        new.replace(self.file)  # the process may be killed at any moment
