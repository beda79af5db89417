"""Notes: what tables, reports, verdicts and verbs say beside their numbers.

A note is a record of facts, so that code and tests compare facts. Its sentence is made here alone.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Self

from gsbench.events import FEW_ROUNDS
from gsbench.parsing import table_beside
from gsbench.words import FORM


@dataclass(frozen=True)
class Note:
    """A note of a kind in `SENTENCES`, with its facts; ``str`` gives the kind's sentence."""

    kind: str
    facts: tuple[tuple[str, Any], ...] = ()

    @classmethod
    def of(cls, kind: str, **facts: Any) -> Self:
        """Make a note; lists become tuples, so that equal notes count once in a set."""
        known = {key: tuple(f) if isinstance(f, list) else f for key, f in facts.items()}
        return cls(kind, tuple(known.items()))

    def __getitem__(self, fact: str) -> Any:
        return dict(self.facts)[fact]

    def __str__(self) -> str:
        return FORM.format(SENTENCES[self.kind], **dict(self.facts))


SENTENCES: dict[str, str] = {
    **table_beside(__file__, "notes.yaml"),
    "few rounds": FEW_ROUNDS,
}


def texts(notes: Iterable[object]) -> list[str]:
    """The sentences of notes, each once."""
    return list(dict.fromkeys(map(str, notes)))
