"""Destinations of gsbench's log lines: stderr for people, and a trial's own file."""

import logging
import os
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Protocol, TextIO

from rich import progress as bars
from rich.console import Console
from rich.markup import escape

from gsbench.files import open_plain
from gsbench.words import printable

LOGGER = logging.getLogger("gsbench")


class _Printable(logging.Formatter):
    """What is logged may quote anybody's file or program; no terminal that shows it obeys it."""

    def format(self, record: logging.LogRecord) -> str:
        return printable(super().format(record))


class PrintableStream:
    """A text stream of the program's in which everything is `printable`; ``raw`` is the stream as it was."""

    def __init__(self, raw: TextIO) -> None:
        self.raw = raw

    def __getattr__(self, name: str) -> Any:
        return getattr(self.raw, name)

    def write(self, text: str) -> int:
        self.raw.write(printable(text))
        return len(text)

    def writelines(self, lines: Sequence[str]) -> None:
        for line in lines:
            self.write(line)


@contextmanager
def printable_output() -> Iterator[None]:
    """Let what the block prints, and what the libraries that it calls print, be `printable`."""
    out, err = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = PrintableStream(out), PrintableStream(err)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = out, err


class _People(logging.StreamHandler[TextIO]):
    """Shows lines on what is stderr at that moment."""

    def emit(self, record: logging.LogRecord) -> None:
        self.stream = sys.stderr  # another than at the start, where a program that calls gsbench redirects it
        super().emit(record)


def set_up_logging() -> None:
    """Show what gsbench logs, from INFO on, on stderr."""
    if not LOGGER.handlers:
        handler = _People()
        handler.setLevel(logging.INFO)
        handler.setFormatter(_Printable("%(message)s"))
        LOGGER.addHandler(handler)
        LOGGER.setLevel(logging.DEBUG)
        LOGGER.propagate = False


@contextmanager
def log_to(path: Path) -> Iterator[None]:
    """Write everything that gsbench logs within the block, tracebacks included, to ``path`` as well."""
    handler = _QuietHandler(os.fdopen(open_plain(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT), "a", encoding="utf-8"))
    handler.setLevel(logging.DEBUG)
    handler.setFormatter(_Printable("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    LOGGER.addHandler(handler)
    try:
        yield
    finally:
        LOGGER.removeHandler(handler)
        with suppress(OSError):
            handler.stream.close()


class _QuietHandler(logging.StreamHandler[TextIO]):
    """Keeps silent where it cannot write: on a full disk the trial's own error says so."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 - logging's name
        return


log = logging.getLogger(__name__)

SECONDS_BETWEEN_LINES = 20.0


class Progress(Protocol):
    """Receiver of a ``phase``'s progress: ``done`` of a ``total`` that may be unknown.

    The unit is the phase's own (images, pairs, bytes), and a phase may start anew at 0. ``note`` is shown as it is.
    """

    def __call__(self, phase: str, done: int, total: int | None, note: str = "") -> None: ...


def no_progress(phase: str, done: int, total: int | None, note: str = "") -> None:
    """A `Progress` that reports nowhere."""


@contextmanager
def progress(title: str) -> Iterator[Progress]:
    """Show progress of the work called ``title`` while the block runs."""
    console = Console(file=getattr(sys.stderr, "raw", sys.stderr))  # which may obey: it draws a bar
    if not console.is_terminal:
        yield _lines(title)
        return
    columns = (
        bars.TextColumn("{task.description}"),
        bars.BarColumn(),
        bars.TextColumn("{task.fields[note]}"),
        bars.TimeRemainingColumn(),
    )
    with bars.Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(title, total=None, note="")

        def report(phase: str, done: int, total: int | None, note: str = "") -> None:
            bar.update(
                task,
                description=f"{title}: {phase}",
                completed=done,
                total=total,
                note=escape(printable(note)) or f"{done}/{total}",
            )

        yield report


def _lines(title: str) -> Progress:
    last_phase, last_done, last_time = "", -1, 0.0

    def report(phase: str, done: int, total: int | None, note: str = "") -> None:
        nonlocal last_phase, last_done, last_time
        now = time.monotonic()
        ends = done == total and done != last_done
        if phase != last_phase or ends or now - last_time >= SECONDS_BETWEEN_LINES:
            last_phase, last_done, last_time = phase, done, now
            log.info("%s: %s %d/%s %s", title, phase, done, "?" if total is None else total, note)

    return report
