"""Logging to stderr and to a trial's own file, and progress bars."""

from __future__ import annotations

import logging
import os
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TextIO

from gsbench.errors import GsbenchError
from gsbench.files import open_plain
from gsbench.words import printable

if TYPE_CHECKING:
    from rich.console import Console

LOGGER = logging.getLogger("gsbench")
# Loggers of warnings about a scene, which all trials of a sweep would repeat: the terminal shows
# each once in a command, and every trial's log has it.
OF_SCENES = ("gsbench.scene.", "gsbench.train.start.")
_shown_of_scenes: set[str] = set()


class _Printable(logging.Formatter):
    """Makes log lines `printable`, since they may quote control characters from elsewhere."""

    def format(self, record: logging.LogRecord) -> str:
        return printable(super().format(record))


class OutputError(GsbenchError):
    """Raised if the standard output, such as a file on a full disk, cannot be written to."""


class PrintableStream:
    """A stream that writes to ``raw`` and makes everything `printable`.

    Characters that its encoding lacks are escaped too, such as ↑ where only ASCII can be printed.
    If it cannot be written to, a stream with results (``is_result``) raises OutputError; lines
    that only accompany the work are lost.
    """

    def __init__(self, raw: TextIO, is_result: bool = True) -> None:
        self.raw, self._is_result = raw, is_result

    def __getattr__(self, name: str) -> Any:
        return getattr(self.raw, name)

    def write(self, text: str) -> int:
        encoding = getattr(self.raw, "encoding", None) or "utf-8"
        with self._explained():
            self.raw.write(printable(text).encode(encoding, "backslashreplace").decode(encoding))
        return len(text)

    def flush(self) -> None:
        with self._explained():
            self.raw.flush()

    @contextmanager
    def _explained(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            if not self._is_result:
                return
            if isinstance(error, BrokenPipeError):
                raise  # its reader, such as `head`, has ended
            raise OutputError(
                f"the output cannot be written ({error.strerror}): send it elsewhere"
            ) from None

    def writelines(self, lines: Sequence[str]) -> None:
        for line in lines:
            self.write(line)


def open_streams() -> None:
    """Open the null device for each standard stream that is closed, as some cron jobs have them."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number, which is this one
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "w" if number else "r", encoding="utf-8"))


@contextmanager
def printable_output() -> Iterator[None]:
    """Make everything that the block and its libraries print `printable`."""
    out, err = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = PrintableStream(out), PrintableStream(err, is_result=False)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = out, err


class _CurrentStderrHandler(logging.StreamHandler[TextIO]):
    """Writes to the present ``sys.stderr``, which may have been redirected meanwhile."""

    def emit(self, record: logging.LogRecord) -> None:
        self.stream = sys.stderr
        super().emit(record)


class _RootHandler(logging.Handler):
    """Passes log lines on to the root logger's handlers, which another library may have added."""

    def emit(self, record: logging.LogRecord) -> None:
        logging.getLogger().handle(record)


def begin_command() -> None:
    """Set up logging for a command, which shows each warning about a scene once."""
    _shown_of_scenes.clear()
    set_up_logging()


def set_up_logging(verbose: bool | str | Sequence[str] = False, through_root: bool = False) -> None:
    """Show gsbench's log lines of level INFO and above on stderr.

    With ``through_root``, the root logger's handlers get them, too; if one of these writes to the
    terminal, gsbench does not. ``verbose`` also shows debug lines: gsbench's if it is True, else
    those of the loggers that it names.
    """
    given = () if isinstance(verbose, bool) else verbose
    names = [given] if isinstance(given, str) else list(given)

    def shown(record: logging.LogRecord) -> bool:
        named = any(f"{record.name}.".startswith(f"{name}.") for name in names)
        return (record.levelno >= logging.INFO or verbose is True or named) and _is_new(record)

    others = logging.getLogger().handlers if through_root else []
    consoles = [other for other in others if type(other) is logging.StreamHandler]
    # Their streams were made before this command: `PrintableStream` would escape their colours.
    for console in consoles:
        console.addFilter(_make_printable)  # the lines, not the formatter's colours
        console.setStream(getattr(console.stream, "raw", console.stream))
    handlers: list[logging.Handler] = [_RootHandler()] if through_root else []
    if not consoles:
        handlers.append(_CurrentStderrHandler())
        handlers[-1].setFormatter(_Printable("%(message)s"))
    for handler in handlers:
        handler.addFilter(shown)
    foreign = [] if through_root else [name for name in names if name.split(".")[0] != LOGGER.name]
    for logger in (LOGGER, *map(logging.getLogger, foreign)):
        kept = [
            old
            for old in logger.handlers
            if not isinstance(old, _CurrentStderrHandler | _RootHandler)
        ]
        logger.handlers = [*handlers, *kept]
        logger.setLevel(logging.DEBUG)  # `shown` decides
    LOGGER.propagate = False


def _is_new(record: logging.LogRecord) -> bool:
    """Return whether a warning about a scene has not been shown by this command."""
    if record.levelno < logging.WARNING or not f"{record.name}.".startswith(OF_SCENES):
        return True
    known = vars(record)
    if "is_new" not in known:  # several handlers ask about one record
        known["is_new"] = record.getMessage() not in _shown_of_scenes
        _shown_of_scenes.add(record.getMessage())
    return known["is_new"]


def _make_printable(record: logging.LogRecord) -> bool:
    record.msg, record.args = printable(record.getMessage()), None
    return True


@contextmanager
def log_to(path: Path) -> Iterator[None]:
    """Also write what gsbench logs within the block, with tracebacks, to ``path``."""
    handler = _QuietHandler(
        os.fdopen(open_plain(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT), "a", encoding="utf-8")
    )
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
    """Ignores failed writes, because on a full disk the trial itself raises an error."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 - logging's name
        return


log = logging.getLogger(__name__)

SECONDS_BETWEEN_LINES = 20.0


class Progress(Protocol):
    """Receives the progress of a ``phase``: ``done`` of ``total``, which is None if unknown.

    Each phase has its own unit (images, pairs, bytes), and may start again at 0. ``note`` is shown
    unchanged.
    """

    def __call__(self, phase: str, done: int, total: int | None, note: str = "") -> None: ...


def no_progress(phase: str, done: int, total: int | None, note: str = "") -> None:
    """A `Progress` that reports nothing."""


@contextmanager
def progress(title: str) -> Iterator[Progress]:
    """Show progress of the work called ``title`` while the block runs."""
    console = _console()
    if not console.is_terminal:
        yield _lines(title)
        return
    from rich import progress as bars
    from rich.markup import escape

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


def bar(title: str) -> AbstractContextManager[Progress]:
    """`progress` on a terminal, with the time left; elsewhere nothing is shown."""
    return progress(title) if _console().is_terminal else nullcontext(no_progress)


def _console() -> Console:
    from rich.console import Console  # here, for a quick start of every command

    # raw, since a bar needs control characters
    return Console(file=getattr(sys.stderr, "raw", sys.stderr))


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
