"""Notes: what tables, reports, verdicts and verbs say beside their numbers.

A note is a record of facts, so that code and tests compare facts. Its sentence is made here alone.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Self

from gsbench.events import FEW_ROUNDS
from gsbench.words import FORM


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


SENTENCES: dict[str, str] = {
    # ---- pairs of trials that cannot be compared
    "unlike": "{text}",  # the whole text of an error
    "conditions": "{scene}: the arms differ in {conditions:list}, so they are not compared",
    "same capture": "{scene} has the photographs of {other}, so it is no further scene",
    "valueless": "{places:few} not compared: {reason}",
    "uneven": (
        "{least:n seed} of each scene can count: there are no more of {scenes:few} (others have up "
        "to {most})"
    ),
    # ---- questions that cannot be tested
    "equal": (
        "both arms of {pairs:n pair} of trials are equal to the last bit: the settings that differ "
        "had no effect at this size"
    ),
    # ---- arms and trials in no verdict
    "no partner": "{arm} is not compared: nothing was trained to compare it with.",
    "unused": "Not in the verdict on {arm}, whose question did not name them: {trials:few}.",
    # ---- arms that are unlike in more than was asked
    "scenes differ": "Scenes of {arms:all} differ in more than the scene: {differences}.",
    "unequal counts": (
        "Unequal numbers of Gaussians: {arms:all} than {baseline}. To compare at equal ones: "
        "{advice}."
    ),
    "no ingredient": "{arm} and {baseline} differ in no recorded setting.",
    "ingredients": "{arm} differs from {baseline} by {ingredients:all}{alone}.",
    "compared": "Compared: {pairs:n pair} of trials of one scene and seed.",
    # ---- the tuning of arms
    "no tuning": "No search is recorded. What was tried elsewhere is not known.",
    "unlike tuning": "They were not tuned alike: {arms:all}.",
    "vain search": "{arm}: the search {experiment} found nothing.",
    "search": (
        "{arm}: the best of {points:n point} by {metric} of validation views ({scenes:all}; seed "
        "{seeds:list}; the search {experiment}) is {chosen:all}. Tried: "
        "{tried:list}{more:if: and % more}.{others}"
    ),
    # ---- verdicts, and what was declared
    "same bits": (
        "The same bits in all trials of one scene and seed: {arms:all}. The settings in which they "
        "differ had no effect, so there is nothing to compare."
    ),
    # ---- gates
    "other machine": (
        "deviation: the baseline ran on another kind of machine ({baseline:all}) than the new "
        "trials ({new:all}); this alone changes last digits and, after long training, results"
    ),
    "other library": (
        "deviation: the baseline was made with {library} {baseline:all}, the new trials with "
        "{new:all}"
    ),
    # ---- how to read a table
    "one trial": "One trial per cell, so there is no deviation. Protocol {protocols:list}.{bold}",
    "mean": (
        "Mean over {trials:n trial}; ± is the deviation (n − 1) over {spread}. Protocol "
        "{protocols:list}.{bold}"
    ),
    "folded": "{shown} stands for {others:few}, which change together with it.",
    "few values": "(k/{trials}): k of {trials:n trial} with a value; —: none.",
    "not available": "n/a, {reason}.",
    "no mean": "No mean over the scenes is shown, since they differ in conditions or code.",
    "unusable": "Left out ({count}): {folders:few}.",
    # ---- trials: who made them, on what, and doubts
    "worthless": "{mark} {trial} is {what}{others}.",
    "passed over": "{text}.",
    "few rounds": FEW_ROUNDS,
    "odd": "{scene} {init}: {doubt}.",
    "accepted": "{scene} {init}, accepted by scene.accept=[{rule}]: {doubt}.",
    "program's model": (
        "Trained here by another program, its model rendered by gsbench (its time is that of the "
        "whole program, and it sets its own budget): {arms:list}."
    ),
    "program's renders": (
        "Trained here by another program, its own renders measured as they are (its time is that "
        "of the whole program, and it sets its own budget): {arms:list}."
    ),
    "foreign model": (
        "A model that another program trained, rendered here (its conditions are not known): "
        "{arms:list}."
    ),
    "foreign renders": (
        "Renders of another program, measured as they are (its conditions are not known): "
        "{arms:list}."
    ),
    "machines": (
        "The trials ran on {kinds} kinds of machine: {trials:parts}. There equal settings give "
        "other last digits and, after thousands of iterations, other results."
    ),
    "clouds": (
        "{scene}: trials of init {init} started from {clouds} different clouds ({trials:parts})."
    ),
    "held out": "Held out{question:if: (%)}{scenes:if:, %}: {rule}; {views}.",
    "points of all": (
        "Initial points of {init}: from all views, test views included (init.points_from=all)."
    ),
    "points of some": (
        "Initial points of {init}: from training views alone (init.points_from={choice})."
    ),
}


def texts(notes: Iterable[object]) -> list[str]:
    """The sentences of notes, each once."""
    return list(dict.fromkeys(map(str, notes)))
