"""Progress for people: a live bar on a terminal, a line now and then in a log."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

log = logging.getLogger(__name__)

SECONDS_BETWEEN_LINES = 20.0


class Report(Protocol):
    """Called with how far a piece of work is, of a ``total`` that may be unknown; ``note`` is shown as it is."""

    def __call__(self, phase: str, done: int, total: int | None, note: str = "") -> None: ...


@contextmanager
def progress(title: str) -> Iterator[Report]:
    """Show progress of the work called ``title`` while the block runs."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield _lines(title)
        return
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[note]}"), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(title, total=None, note="")

        def report(phase: str, done: int, total: int | None, note: str = "") -> None:
            bar.update(
                task, description=f"{title}: {phase}", completed=done, total=total, note=note or f"{done}/{total}"
            )

        yield report


def _lines(title: str) -> Report:
    last_phase, last_done, last_time = "", -1, 0.0

    def report(phase: str, done: int, total: int | None, note: str = "") -> None:
        nonlocal last_phase, last_done, last_time
        now = time.monotonic()
        ends = done == total and done != last_done
        if phase != last_phase or ends or now - last_time >= SECONDS_BETWEEN_LINES:
            last_phase, last_done, last_time = phase, done, now
            log.info("%s: %s %d/%s %s", title, phase, done, "?" if total is None else total, note)

    return report
