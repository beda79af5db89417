"""The mirror's own process: it does what the trial's process asks, and ends with it."""

from __future__ import annotations

import json
import os
import queue
import signal
import sys
import threading
import time
import traceback
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from gsbench.system.locks import BusyError, hold
from gsbench.tracking.client import connect, ensure_experiment
from gsbench.tracking.source import source_tags
from gsbench.tracking.trial_run import LOCK, TrackedTrial, mirror_trial

SECONDS_AFTER_PARENT = 10.0  # to tell the tracker that the trial's process is gone

Request = dict[str, Any]
Requests = queue.SimpleQueue[Request | None]  # None: the trial's process is gone


def serve() -> None:
    """Answer requests until the trial's process is gone."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what MLflow prints is no answer
    requests: Requests = queue.SimpleQueue()
    threading.Thread(target=_read_requests, args=(requests,), daemon=True).start()
    while (request := requests.get()) is not None:
        answer = _answer(request, requests)
        if answer is None:
            break
        answers.write(json.dumps(answer) + "\n")
        answers.flush()
    os._exit(0)  # no library is torn down: one might hang or crash in it


def _read_requests(requests: Requests) -> None:
    with open(sys.stdin.fileno(), "rb", buffering=0, closefd=False) as lines:
        for line in lines:
            requests.put(json.loads(line))
    requests.put(None)
    time.sleep(SECONDS_AFTER_PARENT)
    os._exit(1)  # whatever hangs


def _answer(request: Request, requests: Requests) -> Request | None:
    """Do what is asked and return the answer; None where the trial's process has gone in between."""
    try:
        match request.pop("do"):
            case "begin":
                return _follow(FollowedTrial(**_with_paths(request)), requests)
            case "sync":
                return {"outcome": "mirrored" if mirror_trial(**_with_paths(request)) else "known"}
            case "prepare":
                runs = Path(request["runs"])
                ensure_experiment(connect(request["uri"], runs), request["experiment"], runs)
                return {"outcome": "prepared"}
            case unknown:
                raise ValueError(f"no such request: {unknown}")
    except BusyError:
        return {"outcome": "busy"}
    except Exception as error:  # noqa: BLE001 - whatever the tracker raises
        return {"outcome": "failed", "error": one_line(error), "trace": traceback.format_exc()}


def _with_paths(request: Request) -> Request:
    return request | {"runs": Path(request["runs"]), "folder": Path(request["folder"])}


class FollowedTrial:
    """A trial in progress, mirrored now and then; a tracker that fails is tried again at the next occasion."""

    def __init__(self, options: dict[str, Any], runs: Path, folder: Path, values: dict[str, Any], program: str) -> None:
        self.seconds_between = float(options["flush_seconds"])
        self.sources = [folder]
        self._trial = (options, runs, folder, values, source_tags(program))
        self._run: TrackedTrial | None = None
        self._monitor: Any = None
        self._lock = ExitStack()

    def catch_up(self) -> None:
        """Log what the files have gained. Raises what the tracker raises, BusyError where another process mirrors."""
        if self._run is None:
            folder = self._trial[2]
            with ExitStack() as stack:
                stack.enter_context(hold(folder / LOCK, "mirroring", wait=False))
                self._run = TrackedTrial(*self._trial)
                self._lock = stack.pop_all()
            if self._trial[0].get("system_metrics") and not self._run.is_complete:
                self._monitor = start_system_metrics(self._run)
        self._run.add_curves(self.sources)

    def end(self, status: str) -> None:
        """Log the rest and close the run with MLflow's ``status``; raises as `catch_up` does."""
        try:
            self.catch_up()
            assert self._run is not None
            if self._monitor is not None:
                self._monitor.finish()
            self._run.finish(status)
        finally:
            self._lock.close()


def _follow(trial: FollowedTrial, requests: Requests) -> Request | None:
    """Mirror a trial until its end is told."""
    pause = 0.0  # the dashboard shows a trial when it begins
    while True:
        try:
            request = requests.get(timeout=pause)
        except queue.Empty:
            pause = trial.seconds_between
            with suppress(Exception):  # what lasts until the end is said then
                trial.catch_up()
            continue
        if request is None:
            with suppress(Exception):
                trial.end("KILLED")
            return None
        if request["do"] == "end":
            trial.end(request["status"])
            return {"outcome": "mirrored"}
        trial.sources = [Path(request["folder"]), *trial.sources[-1:]]


def start_system_metrics(run: TrackedTrial) -> Any:
    """MLflow's own monitor of processors, memory, disk, network and GPUs, which logs to ``run`` until ``finish``."""
    from mlflow.system_metrics.system_metrics_monitor import SystemMetricsMonitor

    monitor = SystemMetricsMonitor(run.state["run_id"], resume_logging=True, tracking_uri=run.client.tracking_uri)
    monitor.start()
    return monitor


def one_line(error: Exception) -> str:
    """Kind and first words of an error, whatever library it comes from."""
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0][:200] if lines else ''}"
