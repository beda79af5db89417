"""A trial's side of the mirror: a process beside it follows its files; at the end it is waited for, a bounded time."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar

from gsbench.tracking.process import MirrorError, MirrorProcess
from gsbench.tracking.sink import name_of

log = logging.getLogger(__name__)

SECONDS_TO_STOP = 3.0  # patience where a signal asks to end
SECONDS_IN_VAIN = 10.0  # patience with a tracker that the last trial waited for in vain


class Mirror:
    """Mirrors the trial in ``folder``, which has its ``config.yaml``, while the ``with`` block runs.

    On leaving it, the tracker is waited for a bounded time: a sweep does not lose all of it at each trial where it was
    in vain before. Whatever the tracker does, nothing is raised: one line in the log says what is missing.
    """

    in_vain: ClassVar[bool] = False  # whether the last trial of this process waited for nothing

    def __init__(self, options: dict[str, Any], runs: Path, folder: Path) -> None:
        self._options, self._runs, self._folder = options, runs, folder
        self._process: MirrorProcess | None = None

    def __enter__(self) -> Mirror:
        if self._options["enabled"]:
            program = Path(sys.argv[0]).name or "python"
            try:
                self._process = MirrorProcess("follow", str(self._runs), str(self._folder), program)
            except OSError as error:
                self._warn(error)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: object) -> None:
        if self._process is None:
            return
        stopped = kind is not None and not issubclass(kind, Exception)
        try:
            self._process.finish(SECONDS_TO_STOP if stopped else self._patience())
        except TimeoutError:
            Mirror.in_vain = True
            log.warning("tracking: %s is slow; `gsbench sync` mirrors the rest of %s later", self._name, self._folder)
        except MirrorError as broken:
            self._warn(broken)
        else:
            Mirror.in_vain = False

    def _patience(self) -> float:
        seconds = float(self._options["patience_seconds"])
        return min(seconds, SECONDS_IN_VAIN) if Mirror.in_vain else seconds

    @property
    def _name(self) -> str:
        return name_of(self._options)

    def _warn(self, error: object) -> None:
        log.warning("tracking: %s; the files are complete, `gsbench sync` mirrors them later", error)


def prepare(options: dict[str, Any], runs: Path, experiment: str) -> None:
    """Create what many processes will need at once; a tracker that fails is only mentioned."""
    if not options["enabled"] or name_of(options) != "MLflow":
        return
    try:
        patience = options["patience_seconds"]
        MirrorProcess("prepare", str(runs), experiment, options["uri"] or "", str(patience)).finish(patience)
    except TimeoutError:
        fault: object = "MLflow is slow"
    except (MirrorError, OSError) as error:
        fault = error
    else:
        return
    log.warning("tracking: %s; the files will be complete, `gsbench sync` mirrors them later", fault)


def sync(runs: Path, homes: Sequence[Path], uri: str | None, anew: bool) -> Iterator[str]:
    """Mirror what the tracker missed of the experiments in ``homes``; yields a line for each trial and one for all.

    With ``anew``, what the tracker shows is deleted first. Raises MirrorError where the tracker does not take it.
    """
    process = MirrorProcess("sync", str(runs), uri or "", "anew" if anew else "", *map(str, homes))
    try:
        yield from process.lines()
        process.finish(None)
    finally:
        process.kill()  # Ctrl-C ends it, whatever the tracker does
