"""Running another program: its time, its memory, and its end.

The process that watches a program imports this module, so it loads neither torch nor a scene.
"""

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

# longest pause between two measurements of the memory of the program and its children
SECONDS_BETWEEN_LOOKS = 0.5
# seconds; pauses double up to SECONDS_BETWEEN_LOOKS, so that short programs are measured too
FIRST_LOOK = 0.02


@dataclass(frozen=True)
class ProgramResult:
    """Exit code, time and memory of a program that has ended."""

    code: int | None  # negative: ended by a signal; None: ended by the time limit
    seconds: float
    peak_memory_mb: float  # resident, of the program and its children together


def run_program(
    command: Sequence[str],
    log: Path,
    folder: Path,
    environment: Mapping[str, str],
    limit: float | None,
) -> ProgramResult:
    """Run ``command`` in ``folder`` for at most ``limit`` seconds, its output in the file ``log``.

    All processes that it started end with it, at the limit, and when gsbench ends for any reason;
    on Linux this includes daemons. Raises `TrainingError`, with the last lines of the log, unless
    it succeeds within the limit.
    """
    name = Path(command[0]).name
    try:
        ended = run_isolated(
            watch, list(command), folder, dict(environment), limit, what=name, log=log
        )
    except CrashError as error:
        raise TrainingError(f"{error}; log: {log}") from error
    if ended.code == 0:
        return ended
    if ended.code is not None:
        what = describe_exit(ended.code)
    else:
        what = f"still ran after {readable_time(limit or 0.0)} (densify.time_limit_minutes)"
    raise TrainingError(f"{name} {what}; its last lines: {error_tail(log)}; log: {log}")


def watch(
    command: Sequence[str], folder: Path, environment: Mapping[str, str], limit: float | None
) -> ProgramResult:
    """Run ``command`` as a child of this process, which `run_isolated` started, and measure it.

    If the program is killed here, `run_isolated` ends the processes that it had started.
    """
    started = time.monotonic()
    program = subprocess.Popen(command, cwd=folder, env=dict(environment), stdin=subprocess.DEVNULL)
    # The operating system reports peaks of single processes only. So the sum over the program and
    # its children is measured repeatedly.
    pause, peak = FIRST_LOOK, 0.0
    while limit is None or time.monotonic() - started < limit:
        peak = max(peak, resident_memory_mb(program.pid))
        with suppress(subprocess.TimeoutExpired):
            code = program.wait(pause)
            return ProgramResult(code, time.monotonic() - started, max(peak, peak_child_mb()))
        pause = min(2 * pause, SECONDS_BETWEEN_LOOKS)
    program.kill()
    program.wait()
    return ProgramResult(None, time.monotonic() - started, peak)


def resident_memory_mb(pid: int) -> float:
    """The resident memory of a process and its descendants in MiB, 0 if the process has ended."""
    total = 0
    with suppress(psutil.Error):
        program = psutil.Process(pid)
        for process in [program, *program.children(recursive=True)]:
            with suppress(psutil.Error):
                total += process.memory_info().rss
    return total / MIB
