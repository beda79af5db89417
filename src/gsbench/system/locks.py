"""Locks between processes: one process works, the others wait and report what for."""

import json
import logging
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from gsbench.errors import InputError
from gsbench.files import open_plain
from gsbench.parsing import Amount, Record, read_if_sound

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

log = logging.getLogger(__name__)

SECONDS_BETWEEN_TRIES = 0.25


class BusyError(Exception):
    """Another process holds the lock."""


@contextmanager
def hold(path: Path, what: str, wait: bool = True) -> Iterator[None]:
    """Hold the lock ``path`` while the block runs; ``what`` is the work that it guards.

    The system frees the lock when the process ends for any reason; the file stays. Raises BusyError
    if another process holds the lock and ``wait`` is False.
    """
    lock = FileLock(path)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        if not wait:
            raise BusyError(f"{what}: {describe_holder(path)} works on it") from None
        log.info("waiting for %s: %s works on it", what, describe_holder(path))
        lock.acquire(poll_interval=SECONDS_BETWEEN_TRIES)
    holder = _holder_file(path)
    with suppress(OSError):  # this file is only information
        holder.unlink(missing_ok=True)  # first: another process may have made it a link to any file
        with os.fdopen(open_plain(holder, os.O_WRONLY | os.O_CREAT | os.O_EXCL), "w") as stream:
            job = os.environ.get("SLURM_JOB_ID")
            this = LockHolder(
                host=socket.gethostname(), pid=os.getpid(), since=time.time(), slurm=job, what=what
            )
            stream.write(json.dumps(this.to_json()))
    try:
        yield
    finally:
        with suppress(OSError):
            holder.unlink(missing_ok=True)
        lock.release()


def is_held(path: Path) -> bool:
    """Return whether a process holds the lock ``path``. Needs no write permission."""
    if fcntl is None:
        lock = FileLock(path)
        try:
            lock.acquire(timeout=0)
        except (Timeout, OSError):
            return True
        lock.release()
        return False
    try:
        with os.fdopen(open_plain(path)) as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except (OSError, InputError):
        pass
    return False


class LockHolder(Record):
    """A lock's holder: its host, process and Slurm job, since when (Unix time), and its work."""

    host: str
    pid: int
    since: Amount
    slurm: str | None = None
    what: str = ""

    @property
    def description(self) -> str:
        """``process 17 on node3, Slurm job 5``"""
        return (
            f"process {self.pid} on {self.host}{f', Slurm job {self.slurm}' if self.slurm else ''}"
        )


def read_holder(path: Path) -> LockHolder | None:
    """Read what the holder of the lock ``path`` wrote about itself; None if it is not readable."""
    return read_if_sound(_holder_file(path), LockHolder)


def describe_holder(path: Path) -> str:
    """The holder of a lock, for people."""
    holder = read_holder(path)
    return "another process" if holder is None else holder.description


def _holder_file(path: Path) -> Path:
    return path.with_name(f"{path.name}.holder")
