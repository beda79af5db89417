"""A trial's side of the mirror: it tells a process beside it what to follow, and waits a bounded time at the end."""

from __future__ import annotations

import logging
import sys
from pathlib import Path
from typing import Any

from gsbench.tracking.client import tracker_uri
from gsbench.tracking.process import MirrorError, MirrorProcess, processes

log = logging.getLogger(__name__)

SECONDS_TO_STOP = 3.0  # patience where a signal asks to end


class Mirror:
    """Mirrors a trial while the ``with`` block runs; on leaving it, waits a bounded time for the tracker.

    Whatever the tracker does, nothing is raised: one line in the log says what is missing.
    """

    def __init__(self, options: dict[str, Any], runs: Path, folder: Path, values: dict[str, Any]) -> None:
        self._options, self._folder = options, folder
        self._trial = {
            "options": options | {"uri": tracker_uri(options["uri"], runs)},
            "runs": str(runs),
            "folder": str(folder),
            "values": values,
            "program": Path(sys.argv[0]).name or "python",
        }
        self._process: MirrorProcess | None = None

    def __enter__(self) -> Mirror:
        if self._options["enabled"]:
            try:
                self._process = processes.take()
            except OSError as error:
                self._warn(error)
            else:
                self._process.tell("begin", **self._trial)
        return self

    def follow(self, folder: Path) -> None:
        """Read curves from ``folder`` as well: where a training in progress writes them."""
        if self._process is not None:
            self._process.tell("follow", folder=str(folder))

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: object) -> None:
        process, self._process = self._process, None
        if process is None:
            return
        stopped = kind is not None and not issubclass(kind, Exception)
        status = "KILLED" if stopped else "FINISHED" if kind is None else "FAILED"
        patience = SECONDS_TO_STOP if stopped else processes.patience(self._options["patience_seconds"])
        try:
            answer = process.ask("end", patience, status=status)
        except TimeoutError:
            processes.give_up(process)
            log.warning("tracking: MLflow is slow; `gsbench sync` mirrors the rest of %s later", self._folder)
        except MirrorError as broken:
            process.close()
            self._warn(broken)
        except BaseException:
            process.kill()
            raise
        else:
            processes.give_back(process)
            self._report(answer)

    def _report(self, answer: dict[str, Any]) -> None:
        if answer["outcome"] == "failed":
            log.debug("tracking failed:\n%s", answer["trace"])
            self._warn(answer["error"])
        elif answer["outcome"] == "busy":
            log.debug("another process mirrors %s", self._folder)

    def _warn(self, error: object) -> None:
        log.warning("tracking: %s; the files are complete, `gsbench sync` mirrors them later", error)


def prepare(options: dict[str, Any], runs: Path, experiment: str) -> None:
    """Create tables and ``experiment`` before many processes need them; a tracker that fails is only mentioned."""
    if not options["enabled"]:
        return
    request = {"uri": tracker_uri(options["uri"], runs), "runs": str(runs), "experiment": experiment}
    try:
        with MirrorProcess() as process:
            answer = process.ask("prepare", options["patience_seconds"], **request)
        fault: object = answer.get("error")
    except TimeoutError:
        fault = "MLflow is slow"
    except (MirrorError, OSError) as error:
        fault = error
    if fault:
        log.warning("tracking: %s; the files will be complete, `gsbench sync` mirrors them later", fault)
