"""Stopping on a signal: at once, or, in a training, after the current iteration, with a checkpoint.

The state in this module is global, because signals belong to the process. SIGINT is Ctrl-C. SIGTERM
comes from shells, and from Slurm when a job is preempted or cancelled. SIGUSR2 comes from submitit
shortly before a job's time is up.
"""

import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType

SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGUSR2") if hasattr(signal, name)
)
# For a process that ignores Ctrl-C because its parent handles it and ends the process.
SIGNALS_WITHOUT_INTERRUPT = tuple(signum for signum in SIGNALS if signum != signal.SIGINT)


class Stopped(KeyboardInterrupt):
    """Raised when a signal stops the program. Results so far are kept."""

    def __init__(self, signum: int) -> None:
        super().__init__(signal.Signals(signum).name)
        self.signum = signum

    @property
    def exit_code(self) -> int:
        """128 plus the signal's number, as shells count."""
        return 128 + self.signum


class _State:
    signals: Sequence[int] = ()  # signals handled by the present stop_on_signals
    deferring = 0  # number of nested ``deferred`` blocks
    requested: int | None = None  # a signal that a ``deferred`` block has received


def requested() -> bool:
    """Return whether the present ``deferred`` block has received a signal and should end."""
    return _State.requested is not None


@contextmanager
def stop_on_signals(signals: Sequence[int] = SIGNALS) -> Iterator[None]:
    """Raise `Stopped` in the main thread if a signal comes within the block.

    The earlier handlers are restored after it.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    earlier = {signum: signal.signal(signum, _on_signal) for signum in signals}
    earlier_signals, _State.signals = _State.signals, signals
    try:
        yield
    finally:
        _State.signals = earlier_signals
        for signum, handler in earlier.items():
            signal.signal(signum, handler)
        _State.requested = None


@contextmanager
def interrupts_ignored() -> Iterator[None]:
    """Ignore Ctrl-C within the block.

    Processes started in it inherit this and always ignore Ctrl-C.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)


def reinstall_handlers() -> None:
    """Install the handlers of `stop_on_signals` again.

    Importing pycolmap replaces the handler of SIGTERM.
    """
    if threading.current_thread() is threading.main_thread():
        for signum in _State.signals:
            signal.signal(signum, _on_signal)


@contextmanager
def deferred() -> Iterator[None]:
    """Defer a first signal within the block: it sets `requested` and raises `Stopped` at the end.

    A second signal raises `Stopped` at once.
    """
    reinstall_handlers()
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
