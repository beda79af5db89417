"""Notes: what tables, reports, verdicts and verbs say beside their numbers.

A note is a record of facts, so that code and tests compare facts. Its sentence is made here alone.
"""

import string
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Self

from gsbench.words import counted, listed, some_of


@dataclass(frozen=True)
class Note:
    """A note of a kind in `SENTENCES`, with its facts; ``about`` is the metric that it is about.

    Its text (``str``) is the kind's sentence.
    """

    kind: str
    facts: tuple[tuple[str, Any], ...] = ()
    about: str = ""

    @classmethod
    def of(cls, kind: str, **facts: Any) -> Self:
        """Make a note; lists become tuples, so that equal notes count once in a set."""
        known = {key: tuple(f) if isinstance(f, list) else f for key, f in facts.items()}
        return cls(kind, tuple(known.items()))

    def __getitem__(self, fact: str) -> Any:
        return dict(self.facts)[fact]

    @property
    def sentence(self) -> str:
        """The sentence without the metric."""
        return FORM.format(SENTENCES[self.kind], **dict(self.facts))

    def __str__(self) -> str:
        return f"{self.about}: {self.sentence}" if self.about else self.sentence


class _Form(string.Formatter):
    """The format of facts in sentences.

    ``{count:n trial}`` gives ``2 trials``, ``{names:few}`` the first names and a count of the
    rest, ``{names:all}`` all names with "and" before the last, ``{names:list}`` all with commas,
    and ``{name:if: by %}`` gives `` by NAME``, or nothing if the fact is empty.
    """

    def format_field(self, value: Any, spec: str) -> str:
        if spec.startswith("n "):
            return counted(value, spec[2:])
        if spec.startswith("if:"):
            return spec[3:].replace("%", str(value)) if value else ""
        joined = {"few": some_of, "all": listed, "list": ", ".join}.get(spec)
        return joined([*map(str, value)]) if joined else str(super().format_field(value, spec))


FORM = _Form()

SENTENCES: dict[str, str] = {
    # ---- pairs of trials that cannot be compared
    "unlike": "{text}",  # the whole text of an error
    "conditions": "{scene}: the arms differ in {conditions:list}, so they are not compared",
    "unpaired": "{scene}: seed {seed} has no partner",
    "valueless": "{places:few}: {reason}",
    "uneven": (
        "{least:n seed} of each scene count, since {scenes:few} has no more (others up to {most})"
    ),
    "no pairs": "no trials of {baseline} and {arm} can be paired",
    "no value": "{reason}",
    # ---- questions that cannot be tested
    "equal": (
        "both arms of {pairs:n pair} of trials are equal to the last bit: the settings that differ "
        "had no effect at this size"
    ),
    "as given": "{text}",  # a reason from a file of claims
    "seen": (
        "{trials:n trial} had been measured before this was declared. So the metric shares the "
        "error rate with all metrics that could have been chosen"
    ),
    # ---- arms and trials in no verdict
    "no partner": "{arm} is not compared: there is no {partner}.",
    "lone baseline": (
        "{arm} is not compared: it has the baseline's densifier, and no other arm has its "
        "initialiser."
    ),
    "far baseline": (
        "{arm} is not compared: other arms have a baseline with settings nearer to theirs."
    ),
    "unused": "In no verdict: {trials:few} ({reasons:few}).",
    "not planned": "seeds after an undeclared or missing one do not count",
    "decided before": "the question was decided with {seeds:n seed}",
    "not asked": "no declared question is about them",
    # ---- arms that are unlike in more than was asked
    "scenes differ": "Scenes of {arms:all} differ in more than the scene: {differences}.",
}


def texts(notes: Iterable[object]) -> list[str]:
    """The sentences of notes, each once."""
    return list(dict.fromkeys(map(str, notes)))
