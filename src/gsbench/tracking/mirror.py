"""Mirroring: a process beside the trials reads their files and sends new records to trackers.

Why a process: a tracker's client may hang in a socket, a lock or a C library for any time. A
hanging thread cannot be ended, and a thread that is inside a C library when the interpreter exits
crashes the process, after a trial that was complete. A process can be killed.

`Mirror` starts the process, and at the end waits for it a bounded time. `follow` is the main
function of the process. It gets folders and settings on stdin, and reads everything else from
files. Its exit code says how it ended, and the last line on its stderr says why. `sync` mirrors,
once, the trials that have ended.
"""

from __future__ import annotations

import json
import logging
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
import uuid
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import (
    AbstractContextManager,
    ExitStack,
    chdir,
    closing,
    nullcontext,
    suppress,
)
from dataclasses import replace
from pathlib import Path
from queue import Empty, Queue
from typing import Any, NoReturn

from gsbench.config.build import build
from gsbench.config.trust import foreign_address
from gsbench.errors import InputError
from gsbench.files import write_json
from gsbench.parsing import read_if_sound
from gsbench.runs.layout import CONFIG, FAILED, LOG, RESULTS
from gsbench.runs.nested import GSBENCH
from gsbench.runs.trial_folder import TrialFolder
from gsbench.system.isolate import describe_exit, error_lines, python_command
from gsbench.system.locks import BusyError, hold
from gsbench.system.own_modules import allowed_modules
from gsbench.system.programs import own_folder, safe_environment
from gsbench.tracking.comparison import publish
from gsbench.tracking.mlflow_sink import VARIABLE, absolute_address
from gsbench.tracking.sinks import Run, Sink
from gsbench.tracking.trial import TrackedTrial
from gsbench.words import counted

log = logging.getLogger(__name__)

# exit code if the tracker, or a file, is at fault: the last line on stderr says why
TRACKER_FAILED = 3
SECONDS_BETWEEN_TABLES = 60.0  # an experiment of thousands of trials takes seconds to read
SECONDS_TO_STOP = 3.0  # patience after a signal that asks to end
OWN = "gsbench.tracking."
MLFLOW = f"{OWN}MLflow"
# The settings ``tracking`` that are not options of the tracker's class; configurations of earlier
# versions name it by ``sink``.
NOT_OPTIONS = ("name", "enabled", "flush_seconds", "patience_seconds", "images", "model", "sink")


def class_of(options: Mapping[str, Any]) -> str:
    """The import path of the tracker's class that the settings ``tracking`` name."""
    return str(options.get("_target_") or MLFLOW)


def place_for(options: Mapping[str, Any]) -> AbstractContextManager[str | Path]:
    """The folder to call a tracker in: an empty one, but a user's own tracker stays here.

    Trackers' clients read settings in the current folder: W&B would take its server's address from
    a stranger's ``wandb/settings``.
    """
    return own_folder() if class_of(options).startswith(GSBENCH) else nullcontext(Path.cwd())


def tracker_name(options: Mapping[str, Any]) -> str:
    """The tracker's name in messages."""
    return class_of(options).removeprefix(OWN)


def make_sink(options: Mapping[str, Any], allowed: Sequence[str]) -> Sink:
    """The tracker that the settings ``tracking`` describe.

    ``allowed`` are the modules whose code may run. Raises InputError naming a wrong setting.
    """
    own = {key: value for key, value in options.items() if key not in NOT_OPTIONS}
    if own.get("uri") is None:
        own.pop("uri", None)
    sink: Sink = build("tracking", own | {"_target_": class_of(options)}, list(allowed))
    return sink


# the errors of a tracker's client; a user's class may even end the process
ERRORS = (Exception, SystemExit)


def with_absolute_address(options: dict[str, Any]) -> dict[str, Any]:
    """The settings ``tracking`` for a process in another folder than the command's."""
    uri = options.get("uri")
    if not uri and class_of(options) == MLFLOW:
        uri = os.environ.get(VARIABLE)
    return options | {"uri": absolute_address(uri)} if uri else options


class MirrorError(Exception):
    """The error of a mirror that could not be written. Its text is the reason, in one line."""


class Mirror:
    """Mirrors the trials that begin within a ``with`` block, by one process; ``idle``: none.

    At the end of the block, it waits a bounded time for the tracker. Errors of the tracker are
    never raised: one line in the log says what is missing.
    """

    def __init__(self, idle: bool = False) -> None:
        self._idle = idle
        self._process: subprocess.Popen[bytes] | None = None
        self._options: dict[str, Any] = {}

    def __enter__(self) -> Mirror:
        return self

    def follow(self, folder: Path, options: dict[str, Any]) -> None:
        """Mirror the trial in ``folder`` with the settings ``tracking`` from start to end."""
        if self._idle or not options["enabled"]:
            return
        self._options = options = with_absolute_address(options)
        try:
            if self._process is not None and self._process.poll() is not None:
                self._finish(self._process, 0)
            if self._process is None:
                self._process = self._start()
            assert self._process.stdin is not None
            self._process.stdin.write(f"{json.dumps([str(folder), options])}\n".encode())
            self._process.stdin.flush()
        except OSError as error:
            self._warn(error)

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: object) -> None:
        stopped = kind is not None and not issubclass(kind, Exception)
        if self._process is not None:
            self._finish(
                self._process,
                SECONDS_TO_STOP if stopped else float(self._options["patience_seconds"]),
            )

    def _start(self) -> subprocess.Popen[bytes]:
        """A fresh interpreter that runs `gsbench.tracking.mirror.follow`.

        Raises OSError where it cannot start.
        """
        self._held = ExitStack()  # as long as the process runs
        folder = self._held.enter_context(place_for(self._options))
        self._errors = self._held.enter_context(tempfile.TemporaryFile())  # noqa: SIM115
        words = (str(self._options["flush_seconds"]), str(self._options["patience_seconds"]))
        return subprocess.Popen(
            python_command(__name__, "follow", *words),
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,  # what MLflow prints
            stderr=self._errors,
            cwd=folder,
            env=safe_environment(),
            # Ctrl-C must reach only the trials' process, which then ends this one
            start_new_session=True,
        )

    def _finish(self, process: subprocess.Popen[bytes], seconds: float) -> None:
        """Close the process's input, wait for its end ``seconds`` at most, then kill it."""
        self._process = None
        with self._held, process:
            try:
                process.communicate(timeout=seconds)
            except subprocess.TimeoutExpired:
                log.warning(
                    "tracking: %s is slow; `gsbench sync` mirrors the rest later",
                    tracker_name(self._options),
                )
                return
            finally:  # also where a signal interrupts the wait
                process.kill()
            self._errors.seek(0)
            stderr = self._errors.read()
        if process.returncode == TRACKER_FAILED:
            text = stderr.decode("utf-8", "replace").strip()
            log.debug("tracking failed:\n%s", text)
            self._warn(text.splitlines()[-1])
        elif process.returncode != 0:
            self._warn(
                f"the mirror {describe_exit(process.returncode)}; its last lines: "
                f"{error_lines(stderr)}"
            )

    def _warn(self, error: object) -> None:
        log.warning(
            "tracking: %s; the files are complete, `gsbench sync` mirrors them later", error
        )


# ---- a trial and its tracker

# in the trial's folder: one process at a time mirrors a trial, to any tracker
LOCK = ".mlflow.lock"
# to tell the tracker how trials ended after the sweep's process is gone
SECONDS_AFTER_PARENT = 10.0


class TrackerRun:
    """The tracker's run of the trial in ``folder``, new or continued, locked until it is closed.

    ``options`` are the settings ``tracking``, ``values`` the whole configuration; ``allowed`` are
    the modules whose code may run. Raises BusyError if another process mirrors the trial, and any
    error of the tracker.
    """

    def __init__(
        self,
        folder: TrialFolder,
        options: Mapping[str, Any],
        values: dict[str, Any],
        allowed: Sequence[str] = (),
    ) -> None:
        folder.require_no_links()
        self._options, self._trial = options, TrackedTrial(folder, values)
        name = tracker_name(options)
        own = class_of(options).startswith(OWN)
        self._file = folder.path / f"{name.lower() if own else f'tracker-{name}'}.json"
        with ExitStack() as held:
            held.enter_context(hold(folder.path / LOCK, "mirroring", wait=False))
            self._sink = make_sink(options, allowed)
            self._open(read_if_sound(self._file, Run) or Run())
            self._held = held.pop_all()

    def close(self) -> None:
        """Let other processes mirror the trial."""
        self._held.close()

    @property
    def is_complete(self) -> bool:
        """Return whether the run shows the trial's present results."""
        results = self._trial.results_hash()
        return results is not None and self._run.complete == results

    def add_curves(self, live: bool = True) -> None:
        """Log the records that were written since the last call.

        A run that shows results is left as it is.
        """
        if self._run.complete is not None:
            return
        for name, newest, scalars in self._trial.curves(self._run.logged, live):
            self._sink.metrics(scalars)
            self._keep(replace(self._run, logged=self._run.logged | {name: newest}))

    def end(self) -> None:
        """Log the rest, and close the run as the trial's files say: failed, done, else killed."""
        if self.is_complete:
            return
        # the run shows earlier results, which new ones have replaced
        if self._run.complete is not None:
            self._open(self._run)
        self.add_curves(live=False)
        folder, sink = self._trial.folder, self._sink
        if folder.has_failed():
            sink.artifacts(self._trial.files((CONFIG, FAILED, LOG)), ())
            sink.close("FAILED", folder.failure().reason)
        elif (results := folder.sound_record()) is None:
            sink.close("KILLED", None)
        else:
            images, with_model = int(self._options["images"]), bool(self._options.get("model"))
            summary = self._trial.summary(results, images, with_model)
            sink.metrics(summary.scalars)
            sink.tags(summary.tags)
            sink.artifacts(summary.files, summary.pictures)
            sink.close("FINISHED", None)
            self._keep(replace(self._run, complete=self._trial.results_hash()))

    def _open(self, run: Run) -> None:
        """Open ``run``, or a new one in its place if it shows results that are not the trial's."""
        if run.token is None or run.complete not in (None, self._trial.results_hash()):
            now = int(time.time() * 1000)
            run = Run(token=uuid.uuid4().hex, started=now, replaces=run.token)
        # Kept before the tracker creates the run, so that the token finds it even if the tracker's
        # answer is lost.
        self._keep(run)
        name = self._sink.open(self._trial, run)
        if name != run.id:
            run = Run(token=run.token, started=run.started, id=name)
        if not run.described:
            self._sink.params(self._trial.params())
            self._sink.tags(self._trial.tags())
        self._keep(replace(run, described=True))

    def _keep(self, run: Run) -> None:
        self._run = run
        write_json(self._file, run.to_json())


# ---- once, after the end


def sync(
    folders: Iterable[TrialFolder], uri: str | None, allowed: Sequence[str] = ()
) -> Iterator[str]:
    """Mirror ended trials that the tracker lacks; yields a line for each, and a summary.

    ``allowed`` are the modules whose code may run, and the addresses that may get results.

    Raises MirrorError if the tracker refuses a trial.
    """
    new = already_there = 0
    pages: Pages = {}
    for folder in folders:
        state = folder.state()
        if state == "damaged":
            yield f"left out: {folder.label}: damaged, see gsbench status"
        if state not in ("done", "failed"):
            continue
        try:
            values = folder.configuration()
        except InputError as error:
            yield f"left out: {error}"
            continue
        options = values["tracking"] | ({"uri": uri} if uri else {})
        # The runs folder may be a stranger's. It must not make gsbench send files or passwords to
        # the stranger's address.
        if address := foreign_address(options, [*allowed, *([uri] if uri else [])]):
            yield (
                f"left out: {folder.label}: its configuration names the tracker {address}, and "
                f"--uri {address} was not typed"
            )
            continue
        options = with_absolute_address(options)
        try:  # a class of a user's is run only with permission
            make_sink(options, allowed)
        except InputError as error:
            yield f"left out: {folder.label}: {error}"
            continue
        try:
            with place_for(options) as place, chdir(place):
                is_new = mirror_ended(folder, options, values, allowed)
            pages[folder.home, options["uri"]] = folder, options
        except BusyError:
            yield f"{folder.label} is being mirrored by another process"
            continue
        except ERRORS as error:
            raise refusal(folder, options, error) from error
        new, already_there = new + is_new, already_there + (not is_new)
        if is_new:
            yield f"mirrored {folder.label}"
    _renew(pages)
    yield f"{counted(new, 'trial')} mirrored now, {already_there} before"


def mirror_ended(
    folder: TrialFolder,
    options: Mapping[str, Any],
    values: dict[str, Any],
    allowed: Sequence[str] = (),
) -> bool:
    """Mirror an ended trial; returns False if the tracker lacks nothing.

    Raises the errors of `TrackerRun`.
    """
    with closing(TrackerRun(folder, options, values, allowed)) as run:
        if run.is_complete:
            return False
        run.end()
        return True


def refusal(folder: TrialFolder, options: Mapping[str, Any], error: BaseException) -> MirrorError:
    """A MirrorError, in one line, for an ``error`` of the tracker's client about a trial."""
    lines = str(error).strip().splitlines()
    reason = f"{type(error).__name__}: {lines[0][:200] if lines else ''}"
    return MirrorError(f"{folder.label} could not be sent to {tracker_name(options)} ({reason})")


# for each experiment and tracker, a trial and its settings ``tracking``
Pages = dict[tuple[Path, str | None], tuple[TrialFolder, dict[str, Any]]]


def _renew(pages: Pages) -> None:
    """Show the present table and verdict of experiments on their pages. Raises MirrorError."""
    for folder, options in pages.values():
        if class_of(options) == MLFLOW:
            try:
                publish(folder.home, options["uri"])
            except Exception as error:  # any error of the tracker's client
                raise refusal(folder, options, error) from error
    pages.clear()


# ---- beside a sweep

Lines = Queue[str | None]  # of stdin; None is the end


def follow() -> NoReturn:
    """Mirror the trials that come on stdin, until it and the trials have ended.

    Each line is JSON: a trial's folder, and its settings ``tracking``.

    Arguments of the process: the time between two readings of the files, and how long the parent
    waits for this process at the end; both in seconds.
    """
    pause, patience = map(float, sys.argv[2:4])
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    lines: Lines = Queue()
    threading.Thread(target=_read_input, args=(lines, patience), daemon=True).start()
    code = 0
    try:
        _follow(lines, pause)
    except Exception as error:  # noqa: BLE001 - any error of the tracker's client
        code = TRACKER_FAILED
        traceback.print_exc()
        print(" ".join(str(error).split()), file=sys.stderr, flush=True)
    os._exit(code)  # skips the clean-up of libraries, which might hang or crash


def _follow(lines: Lines, pause: float) -> None:
    trials: list[_FollowedTrial] = []
    pages: Pages = {}
    renewed_at = 0.0
    last = False
    while not last:
        with suppress(Empty):
            line = lines.get(timeout=pause)
            while line is not None:
                folder, options = json.loads(line)
                trials.append(_FollowedTrial(TrialFolder(Path(folder)), options))
                line = lines.get_nowait()
            last = True
        for trial in trials:
            try:
                trial.catch_up(last)
            except BusyError:
                pass
            except ERRORS as error:  # tried again, and raised the last time
                if last:
                    raise refusal(trial.folder, trial.options, error) from error
        for trial in trials:
            if trial.has_ended:
                pages[trial.folder.home, trial.options["uri"]] = trial.folder, trial.options
        trials = [trial for trial in trials if not trial.has_ended]
        if last or time.monotonic() - renewed_at > SECONDS_BETWEEN_TABLES:
            _renew(pages)
            renewed_at = time.monotonic()


class _FollowedTrial:
    """A trial to mirror with the settings ``options`` of tracking.

    Its run is opened once the trial runs or has ended, or when the sweep ends.
    """

    def __init__(self, folder: TrialFolder, options: dict[str, Any]) -> None:
        # These are the settings that were checked: a trial that has not begun may have a stranger's
        # `config.yaml`, with the stranger's address.
        self.folder, self.options, self.has_ended = folder, options, False
        self._added_at = time.time()
        self._run: TrackerRun | None = None

    def catch_up(self, last: bool) -> None:
        """Send the new records, and the trial's end once it has ended.

        ``last`` says that the sweep has ended.
        """
        # The state is read before the curves: if it says that the trial has ended, the curves are
        # complete.
        state = self.folder.state()
        is_waiting = state != "running" and self._run is None and not self._has_ended_since()
        if not (self.folder.path / CONFIG).exists() or (is_waiting and not last):
            return
        if self._run is None:
            values = self.folder.configuration()
            # the permissions that this process's parent got on its command line
            self._run = TrackerRun(self.folder, self.options, values, tuple(allowed_modules()))
        self._run.add_curves()
        if state != "running":
            self._run.end()
            self._run.close()
            self.has_ended = True

    def _has_ended_since(self) -> bool:
        """Return whether the trial has ended since it was added.

        Result files that are older are of an earlier run.
        """
        for name in (RESULTS, FAILED):
            with suppress(OSError):
                if (self.folder.path / name).stat().st_mtime >= self._added_at:
                    return True
        return False


def _read_input(lines: Lines, patience: float) -> None:
    for line in sys.stdin:
        lines.put(line.rstrip("\n"))
    lines.put(None)
    # The parent kills this process after its patience. If the parent was killed itself, this ends
    # the process, even while the tracker's client hangs.
    time.sleep(patience + SECONDS_AFTER_PARENT)
    os._exit(1)
