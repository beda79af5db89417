"""Where gsbench's log lines go: to stderr for people, and into a trial's own file."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

LOGGER = logging.getLogger("gsbench")


def set_up_logging() -> None:
    """Show what gsbench logs, from INFO on, on stderr."""
    if not LOGGER.handlers:
        handler = logging.StreamHandler()
        handler.setFormatter(logging.Formatter("%(message)s"))
        handler.setLevel(logging.INFO)
        LOGGER.addHandler(handler)
        LOGGER.setLevel(logging.DEBUG)
        LOGGER.propagate = False


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
