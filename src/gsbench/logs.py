"""Where gsbench's log lines go: to stderr for people, and into a trial's own file."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

LOGGER = logging.getLogger("gsbench")


class _People(logging.StreamHandler):
    """Shows lines from INFO on, and all of the loggers that are ``watched``."""

    watched: tuple[str, ...] = ()

    def filter(self, record: logging.LogRecord) -> bool:
        family = f"{record.name}."
        return record.levelno >= logging.INFO or any(family.startswith(f"{name}.") for name in self.watched)


def set_up_logging() -> None:
    """Show what gsbench logs, from INFO on, on stderr."""
    if not LOGGER.handlers:
        handler = _People()
        handler.setFormatter(logging.Formatter("%(message)s"))
        LOGGER.addHandler(handler)
        LOGGER.setLevel(logging.DEBUG)
        LOGGER.propagate = False


def show_details(loggers: bool | str | Sequence[str]) -> None:
    """Show on stderr also what these loggers log for debugging; ``True`` (as ``hydra.verbose``) means gsbench's own."""
    if isinstance(loggers, bool):
        loggers = [LOGGER.name] * loggers
    names = [loggers] if isinstance(loggers, str) else list(loggers)
    for people in (handler for handler in LOGGER.handlers if isinstance(handler, _People)):
        people.watched = tuple(names)
        for logger in map(logging.getLogger, names):
            logger.setLevel(logging.DEBUG)
            if not f"{logger.name}.".startswith(f"{LOGGER.name}.") and people not in logger.handlers:
                logger.addHandler(people)


@contextmanager
def log_to(path: Path) -> Iterator[None]:
    """Write everything that gsbench logs within the block, tracebacks included, to ``path`` as well."""
    handler = _QuietFileHandler(path, encoding="utf-8")
    handler.setLevel(logging.DEBUG)
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    LOGGER.addHandler(handler)
    try:
        yield
    finally:
        LOGGER.removeHandler(handler)
        with suppress(OSError):
            handler.close()


class _QuietFileHandler(logging.FileHandler):
    """Keeps silent where it cannot write: on a full disk the trial's own error says so."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 - logging's name
        return
