"""Another program, run to its end or to a limit of time, of which nothing is left running."""

import subprocess
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import psutil

from gsbench.errors import TrainingError
from gsbench.system.isolate import CrashError, describe_exit, error_tail, run_isolated
from gsbench.system.resources import MIB, peak_child_mb
from gsbench.words import readable_time

SECONDS_BETWEEN_LOOKS = 0.5  # at the memory of the program and its children
FIRST_LOOK = 0.02  # seconds; the pauses double up to the above, so that a short program is seen too


@dataclass(frozen=True)
class Ended:
    """End of a program: its exit code (negative: by a signal; None: its time was up), and what it took."""

    code: int | None
    seconds: float
    peak_memory_mb: float  # resident, of the program and its children together


def run_program(
    command: Sequence[str],
    log: Path,
    folder: Path,
    environment: Mapping[str, str],
    limit: float | None,
) -> Ended:
    """Run ``command`` in ``folder`` with ``environment``, its output in the file ``log``; ``limit`` is in seconds.

    All that it started ends with it, with the limit, and with gsbench, however that ends; daemons do so on Linux.
    Raises `TrainingError`, with the last words of the log, unless the program ends well and in time.
    """
    name = Path(command[0]).name
    try:
        ended = run_isolated(watch, list(command), folder, dict(environment), limit, what=name, log=log)
    except CrashError as error:
        raise TrainingError(f"{error}; log: {log}") from error
    if ended.code == 0:
        return ended
    if ended.code is not None:
        what = describe_exit(ended.code)
    else:
        what = f"still ran after {readable_time(limit or 0.0)} (densify.time_limit_minutes)"
    raise TrainingError(f"{name} {what}; its last lines: {error_tail(log)}; log: {log}")


def watch(command: Sequence[str], folder: Path, environment: Mapping[str, str], limit: float | None) -> Ended:
    """Run ``command`` as a child of this process, which `run_isolated` started, and measure it.

    What a program that is killed here has started itself, `run_isolated` ends.
    """
    started = time.monotonic()
    program = subprocess.Popen(command, cwd=folder, env=dict(environment), stdin=subprocess.DEVNULL)
    pause, peak = FIRST_LOOK, 0.0
    while limit is None or time.monotonic() - started < limit:
        peak = max(peak, resident_mb(program.pid))
        with suppress(subprocess.TimeoutExpired):
            code = program.wait(pause)
            return Ended(code, time.monotonic() - started, max(peak, peak_child_mb()))
        pause = min(2 * pause, SECONDS_BETWEEN_LOOKS)
    program.kill()
    program.wait()
    return Ended(None, time.monotonic() - started, peak)


def resident_mb(pid: int) -> float:
    """The memory that a process and its descendants have resident now; MiB, 0 where it is gone."""
    total = 0
    with suppress(psutil.Error):
        program = psutil.Process(pid)
        for process in [program, *program.children(recursive=True)]:
            with suppress(psutil.Error):
                total += process.memory_info().rss
    return total / MIB
