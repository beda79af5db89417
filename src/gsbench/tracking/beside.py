"""`gsbench sync --beside`: one process beside a sweep, which sends to trackers what trials write.

Why a process: a tracker's client may hang in a socket, a lock or a C library for any time, and
crash the interpreter when it exits. A process can be killed, and harms no trial. It lives as long
as the sweep, because importing MLflow takes 4 CPU-seconds, and a send a tenth of one. A file tells
it of the trials, whose files it looks at; its standard input ends with the sweep.
"""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from gsbench.parsing import one_line, read_json
from gsbench.runs.layout import CONFIG, FAILED, RESULTS
from gsbench.runs.trial_folder import TrialFolder
from gsbench.system.isolate import describe_exit
from gsbench.system.locks import is_held
from gsbench.system.programs import allow_modules, safe_environment
from gsbench.tracking.sync import MirrorError, sync

if TYPE_CHECKING:
    from gsbench.config.compose import Trial

log = logging.getLogger(__name__)

SECONDS_TO_STOP = 3.0  # patience after a signal that asks to end
SECONDS_BETWEEN_LOOKS = 5.0  # at the trials' files


class Mirror:
    """Sends to their trackers those of ``trials`` that begin within a ``with`` block.

    While the block runs, a process sends every ``tracking.flush_seconds``, and soon after a trial
    has begun or ended; at the end it gets ``tracking.patience_seconds``. Errors of a tracker are
    never raised: one line in the log says what is missing.
    """

    _process: subprocess.Popen[bytes] | None = None
    _said: IO[bytes]  # the process's error output
    _file: Path | None = None  # which tells the process of the trials
    _fault = ""

    def __init__(self, trials: Sequence[Trial]) -> None:
        self._trials = [trial for trial in trials if trial.values["tracking"]["enabled"]]
        options = [trial.values["tracking"] for trial in self._trials]
        self._patience = max((float(one["patience_seconds"]) for one in options), default=0.0)
        told = {
            "trials": {str(trial.folder): _stamps(trial.folder) for trial in self._trials},
            "pause": min((one["flush_seconds"] for one in options), default=0.0),
            "patience": self._patience,
            "allowed": permissions(trial.values for trial in self._trials),
        }
        self._told = json.dumps(told)

    def __enter__(self) -> None:
        if self._trials:
            self._start()

    def _start(self) -> None:
        """Start the process; at the end of the block, replace one that crashed."""
        if self._process and self._process.poll() is None:
            return
        try:
            self._said = tempfile.TemporaryFile()  # noqa: SIM115 - until the process ends
            if self._file is None:
                with tempfile.NamedTemporaryFile("w", prefix="gsbench-", delete=False) as file:
                    self._file = Path(file.name)
                    file.write(self._told)
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "gsbench", "sync", f"--beside={self._file}"],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=self._said,
                env=safe_environment() | {"GSBENCH_RUNS": str(self._trials[0].files.runs)},
                # Ctrl-C must reach only the trials' process, which then ends this one
                start_new_session=True,
            )
        except OSError as error:
            self._fault = str(error)

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: object) -> None:
        if not self._trials:
            return
        is_stopped = kind is not None and not issubclass(kind, Exception)
        if not is_stopped:
            self._start()
        process = self._process
        try:
            if process is not None:
                with suppress(BrokenPipeError):
                    process.stdin.close()  # type: ignore[union-attr]
                process.wait(min(self._patience, SECONDS_TO_STOP) if is_stopped else self._patience)
                self._fault = self._reason(process.returncode)
        except subprocess.TimeoutExpired:
            self._fault = "the tracker is slow"
        finally:  # also where a signal interrupts the wait
            if process is not None:
                process.kill()
                process.wait()
            if self._file is not None:
                self._file.unlink(missing_ok=True)
        if self._fault:
            log.warning(
                "tracking: %s; the files are complete, `gsbench sync` sends them later", self._fault
            )

    def _reason(self, code: int) -> str:
        """The reason of a failure of the process that ended with the exit code; else ""."""
        self._said.seek(0)
        said = self._said.read().decode(errors="replace")
        log.debug("gsbench sync: %s", said)
        lines = said.strip().splitlines() or [f"it {describe_exit(code)}"]
        return one_line(lines[-1]).removeprefix("gsbench: ") if code else ""


def send_beside(file: Path, lines: Iterable[str]) -> None:
    """Send the trials that the file names, as `Mirror` writes it, until ``lines`` end.

    Then all are sent once more; if that takes longer than the file's ``patience``, the process
    ends. So it ends soon after the sweep, even if that was killed, and removes the file then.
    Raises the error of the last send.
    """
    told, stop = read_json(file), threading.Event()

    def end() -> None:
        for _ in lines:
            pass
        file.unlink(missing_ok=True)
        stop.set()
        time.sleep(min(told["patience"], threading.TIMEOUT_MAX))
        os._exit(1)

    threading.Thread(target=end, daemon=True).start()
    allow_modules(allowed := told["allowed"])
    left = {Path(folder): before for folder, before in told["trials"].items()}
    is_last, fault, sent, shown = False, None, time.monotonic(), list[Path]()
    while not is_last:
        is_last = stop.wait(min(told["pause"], SECONDS_BETWEEN_LOOKS))
        now = {folder: _stamps(folder) for folder in left}
        begun = [folder for folder in left if now[folder] != left[folder]]
        # these have written results or a failure, and are at work no longer
        ended = [
            folder
            for folder in begun
            if now[folder][1:] != left[folder][1:] and not is_held(TrialFolder(folder).lock)
        ]
        # while the tracker refuses, a beginning or an end makes no further tries
        is_new = not fault and (ended or not set(begun) <= set(shown))
        if is_last or is_new or time.monotonic() - sent >= told["pause"]:
            shown, fault = begun, _send(begun, allowed)
            sent = time.monotonic()
            for folder in () if fault else ended:
                left[folder] = now[folder]  # another sweep may run it again
    if fault is not None:
        raise fault


def _send(folders: Sequence[Path], allowed: Sequence[str]) -> Exception | None:
    """Send what trackers lack of the trials; returns a tracker's error."""
    try:
        for line in sync(map(TrialFolder, folders), None, allowed):
            log.debug(line)
    except (MirrorError, OSError) as error:
        return error
    return None


def permissions(configurations: Iterator[dict[str, Any]]) -> list[str]:
    """The names that the trials' command allowed, and the addresses of trackers, which it knows.

    The command checked them: an address that only a file names needs permission.
    """
    names: list[object] = []
    for values in configurations:
        names += [*(values.get("allow_targets") or ()), values["tracking"].get("uri")]
    return list(dict.fromkeys(map(str, filter(None, names))))


def _stamps(folder: Path) -> list[int]:
    """The times of change of the files that show a trial's beginning and its end; 0 without one.

    They are only compared with each other, since a file system may have a clock of its own.
    """
    stamps = []
    for name in (CONFIG, RESULTS, FAILED):
        try:
            stamps.append(os.stat(folder / name).st_mtime_ns)
        except OSError:
            stamps.append(0)
    return stamps
