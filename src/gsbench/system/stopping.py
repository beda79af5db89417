"""Stopping on a signal: at once, or in a training at the end of its iteration, with a checkpoint.

Signals belong to the process, and so does the state in this module. SIGINT is Ctrl-C; SIGTERM comes from shells and
from Slurm when a job is preempted or cancelled; SIGUSR2 comes from submitit shortly before a job's time is up.
"""

import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType

SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGUSR2") if hasattr(signal, name))
# Of a process that ignores Ctrl-C, since the one that started it passes it on.
PASSED_ON = tuple(signum for signum in SIGNALS if signum != signal.SIGINT)


class Stopped(KeyboardInterrupt):
    """Signal to the program to end; what was done so far is kept."""

    def __init__(self, signum: int) -> None:
        super().__init__(signal.Signals(signum).name)
        self.signum = signum

    @property
    def exit_code(self) -> int:
        """128 plus the signal's number, as shells count."""
        return 128 + self.signum


class _State:
    signals: Sequence[int] = ()  # that stop, within stop_on_signals
    deferring = 0  # depth of blocks that stop where it suits them
    requested: int | None = None


def requested() -> bool:
    """Return whether a signal came that the present ``deferred`` block has still to act on."""
    return _State.requested is not None


@contextmanager
def stop_on_signals(signals: Sequence[int] = SIGNALS) -> Iterator[None]:
    """Raise `Stopped` in the main thread when a signal comes; the earlier handlers are back afterwards."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    earlier = {signum: signal.signal(signum, _on_signal) for signum in signals}
    before, _State.signals = _State.signals, signals
    try:
        yield
    finally:
        _State.signals = before
        for signum, handler in earlier.items():
            signal.signal(signum, handler)
        _State.requested = None


@contextmanager
def interrupts_ignored() -> Iterator[None]:
    """Ignore Ctrl-C for a moment, so that processes started within the block ignore it for good."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)


def take_signals_back() -> None:
    """Install the handlers again, within `stop_on_signals`: importing pycolmap replaces that of SIGTERM."""
    if threading.current_thread() is threading.main_thread():
        for signum in _State.signals:
            signal.signal(signum, _on_signal)


@contextmanager
def deferred() -> Iterator[None]:
    """Defer signals within the block: a first sets `requested`, a second stops at once; raises `Stopped` at its end."""
    take_signals_back()
    _State.deferring += 1
    try:
        yield
    finally:
        _State.deferring -= 1
    if _State.requested is not None:
        raise Stopped(_State.requested)


def _on_signal(signum: int, frame: FrameType | None) -> None:
    if _State.deferring and _State.requested is None:
        _State.requested = signum
        return
    raise Stopped(signum)
