"""Run a job in a process of its own and hear from it how far it is."""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

from gsbench.logs import Progress
from gsbench.system.isolate import run_isolated

T = TypeVar("T")

POLL_SECONDS = 0.25


class ProgressFile:
    """A `Progress` that writes to a file, for a process to tell its parent; small enough writes are atomic."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __call__(self, phase: str, done: int, total: int | None, note: str = "") -> None:
        with self.path.open("a", encoding="utf-8") as file:
            file.write(f"{phase}\t{done}\t{'' if total is None else total}\t{note}\n")


def run_with_progress(
    function: Callable[[Any, Progress], T], job: Any, progress: Progress, what: str, log: Path | None = None
) -> T:
    """``function(job, progress)`` in a fresh process (see `run_isolated`); its progress is passed on as it comes."""
    with tempfile.TemporaryDirectory(prefix="gsbench-progress-") as folder:
        channel = ProgressFile(Path(folder, "progress.txt"))
        channel.path.touch()
        ended = threading.Event()
        listener = threading.Thread(target=_listen, args=(channel.path, progress, ended), daemon=True)
        listener.start()
        try:
            return run_isolated(function, job, channel, what=what, log=log)
        finally:
            ended.set()
            listener.join()


def _listen(path: Path, progress: Progress, ended: threading.Event) -> None:
    rest = ""
    with path.open(encoding="utf-8") as file:
        while True:
            last = ended.wait(POLL_SECONDS)
            *lines, rest = (rest + file.read()).split("\n")
            for line in lines:
                phase, done, total, note = line.split("\t")
                with suppress(BrokenPipeError):  # a closed terminal must not end the work
                    progress(phase, int(done), int(total) if total else None, note)
            if last:
                return
