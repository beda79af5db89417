"""The file in a trial's folder that says where it is mirrored and how far."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gsbench.records import Count, Part, read_if_sound


@dataclass(frozen=True, kw_only=True)
class MirrorState(Part):
    """State that any sink keeps: ``complete`` is the hash of the results that it shows, ``logged`` the newest iteration
    by file; the rest says which run it is, in the sink's own words.
    """

    complete: str | None = None
    logged: dict[str, Count] = field(default_factory=dict)
    uri: str | None = None
    token: str | None = None
    started: Count | None = None  # ms since 1970
    run_id: str | None = None
    id: str | None = None

    def __post_init__(self) -> None:
        if self.run_id is not None and self.started is None:
            raise ValueError("it has a run and no start")


def read_state(file: Path) -> dict[str, Any]:
    """Read the state in ``file``; empty, as if nothing were mirrored yet, where it is absent or damaged."""
    state = read_if_sound(file, MirrorState)
    return {} if state is None else {"complete": None, "logged": {}} | state.to_json()
