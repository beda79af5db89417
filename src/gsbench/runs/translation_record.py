"""``protocols.json`` of a trial: its renders as the conventions of other programs measure them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from gsbench.records import Number, Part, read_if_sound
from gsbench.runs.layout import PROTOCOLS
from gsbench.runs.trial_record import TrialRecord

VERSION = 1


@dataclass(frozen=True, kw_only=True)
class Translation(Part):
    """A protocol's metrics of a trial, and the share of each convention in the difference to the trial's own.

    ``unknown`` maps a convention that could not be followed to the reason in one line.
    """

    metrics: dict[str, Number]
    unavailable: dict[str, str]
    shares: dict[str, dict[str, Number]] = field(default_factory=dict)
    unknown: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Translations(Part):
    """Translations by the identity of their protocol; ``made_of`` is that of the renders (`made_of`)."""

    version: int
    made_of: str
    protocols: dict[str, Translation]


def made_of(record: TrialRecord) -> str:
    """The identity of a trial's renders: the key of its evaluation, or its configuration's hash."""
    return record.hashes.get("evaluate") or record.hashes.get("config", "")


def read_translations(folder: Path, record: TrialRecord) -> dict[str, Translation]:
    """The translations of the trial in ``folder``; empty where none was made of its present renders."""
    known = read_if_sound(folder / PROTOCOLS, Translations)
    if known is None or known.version != VERSION or known.made_of != made_of(record):
        return {}
    return known.protocols
