"""A round of people's votes in the runs folder: its key, and the file that each person saves."""

import hashlib
import hmac
import itertools
import json
from collections.abc import Iterable
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import MinLen
from pydantic import Field

from gsbench.errors import InputError
from gsbench.files import write_json
from gsbench.parsing import Amount, Count, Record, Text, one_line, read_typed
from gsbench.runs.experiments import Arm, unix_time
from gsbench.runs.layout import VOTE_KEY

PHOTOGRAPH, BLURRED = "photograph", "blurred"  # the sides of a trap
SAME = "same"  # the answer "no difference"

Kind = Literal["pair", "again", "trap"]
Chosen = Literal["most different", "random", ""]
RoundId = Annotated[str, Field(pattern=r"^[0-9a-f]{12}$")]
PersonId = Annotated[str, Field(pattern=r"^[0-9a-f]{16}$")]


class Showing(Record):
    """One decision of a round: ``left`` and ``right`` name arms, or the sides of a trap.

    ``chosen`` says how the view was chosen. ``of`` is the first showing of one that is shown again.
    """

    id: Text
    kind: Kind
    scene: str
    view: str
    seed: Count
    left: Text
    right: Text
    chosen: Chosen = ""
    of: str = ""


class RoundKey(Record):
    """The key of a round, which stays in the runs folder until the votes are there.

    ``arms`` begin with the baseline. ``people`` is the number of people at which the round is
    judged. A person with more than ``traps_allowed`` wrong traps is left out.
    """

    salt: Text
    time: Text
    arms: tuple[Arm, ...]
    people: Count
    traps_allowed: Count
    showings: Annotated[tuple[Showing, ...], MinLen(1)]

    def commitment(self, showing: Showing) -> str:
        """The salted hash of a showing's sides; on the page, it tells nothing without the salt."""
        sides = f"{showing.id} {showing.left} {showing.right}"
        return hmac.new(self.salt.encode(), sides.encode(), hashlib.sha256).hexdigest()

    @cached_property
    def round(self) -> str:
        """The name of the round: a salted hash of the whole key, so a changed key has another."""
        return self.sign(self.to_json())[:12]

    def sign(self, value: Any) -> str:
        """The salted hash of a JSON value."""
        text = json.dumps(value, sort_keys=True)
        return hmac.new(self.salt.encode(), text.encode(), hashlib.sha256).hexdigest()

    @property
    def pairs(self) -> list[Showing]:
        """The showings that count: pairs of arms, seen for the first time."""
        return [showing for showing in self.showings if showing.kind == "pair"]

    @property
    def votes(self) -> int:
        """The number of votes at which the round is judged."""
        return self.people * len(self.pairs)


class Vote(Record):
    """The answer to a showing, and the seconds that it took."""

    showing: Text
    answer: Literal["left", "right", "same"]
    seconds: Amount


class Ballot(Record):
    """The file that a person saves at the end of a round.

    ``finished`` is the time of the last answer.
    """

    round: RoundId
    person: PersonId
    name: Annotated[str, Field(max_length=60)] = ""
    finished: Text
    votes: tuple[Vote, ...]

    def __post_init__(self) -> None:
        if unix_time(self.finished) is None:
            raise ValueError("finished is not a time")

    @property
    def label(self) -> str:
        # a name that a stranger typed may hold line breaks and marks that turn the line around
        name = "".join(filter(str.isprintable, one_line(self.name)))
        return f"{name} ({self.person[:6]})" if name else self.person[:6]

    @cached_property
    def answers(self) -> dict[str, str]:
        return {vote.showing: vote.answer for vote in self.votes}


class StoredBallot(Record):
    """A ballot as the runs folder keeps it.

    ``place`` counts from 0 in the order of handing in. ``seal`` is the key's signature.
    """

    place: Count
    ballot: Ballot
    seal: Text

    @classmethod
    def of(cls, key: RoundKey, place: int, ballot: Ballot) -> "StoredBallot":
        """The sealed ballot."""
        return cls(place=place, ballot=ballot, seal=key.sign([place, ballot.to_json()]))


def read_ballots(folder: Path, key: RoundKey) -> tuple[dict[int, Ballot], dict[str, str]]:
    """The ballots of a round by place, in its order, and by file what is wrong with others."""
    found: dict[int, Ballot] = {}
    faults: dict[str, str] = {}
    for file in sorted(folder.glob("*.json")):
        if file.name == VOTE_KEY:
            continue
        try:
            stored = read_typed(file, StoredBallot)
            if stored != StoredBallot.of(key, stored.place, stored.ballot):
                raise InputError(f"{file} was edited, or is of another round")
            if file.stem != stored.ballot.person or stored.place in found:
                raise InputError(f"{file} is a copy of another file")
            check_ballot(stored.ballot, key, file)
        except (InputError, FileNotFoundError) as error:
            faults[one_line(file.name)] = f"because {one_line(str(error))}"
        else:
            found[stored.place] = stored.ballot
    for place in sorted(set(range(max(found, default=-1))) - found.keys()):
        faults[f"ballot {place + 1}"] = "because it is no longer as it was handed in"
    return dict(sorted(found.items())), faults


def store_ballots(folder: Path, key: RoundKey, ballots: Iterable[Ballot]) -> None:
    """Store new ballots, each in the first free place: by finishing time, after earlier ones."""
    places = set(read_ballots(folder, key)[0])
    for ballot in sorted(
        ballots, key=lambda ballot: (unix_time(ballot.finished) or 0, ballot.person)
    ):
        place = next(place for place in itertools.count() if place not in places)
        places.add(place)
        stored = StoredBallot.of(key, place, ballot)
        write_json(folder / f"{ballot.person}.json", stored.to_json())


def read_key(folder: Path) -> RoundKey:
    """The key of the round in ``folder``.

    Raises InputError if it is missing, damaged or was changed.
    """
    if not (folder / VOTE_KEY).is_file():
        raise InputError(
            f"this experiment has no round {folder.name}: `gsbench vote make` makes rounds"
        )
    key = read_typed(folder / VOTE_KEY, RoundKey)
    if key.round != folder.name:
        raise InputError(
            f"{folder / VOTE_KEY} was changed after the page was made: nothing can be judged by it"
        )
    return key


def check_ballot(ballot: Ballot, key: RoundKey, path: Path) -> None:
    """Raise InputError unless the ballot answers every showing of the round once, and after it."""
    if ballot.round != key.round:
        raise InputError(f"{path} is of the round {ballot.round}, not of {key.round}")
    if (unix_time(ballot.finished) or 0) < (unix_time(key.time) or 0):
        raise InputError(
            f"{path} was finished at {ballot.finished}, before its round was made ({key.time}): "
            "a vote with a wrong clock does not count"
        )
    showings = {showing.id for showing in key.showings}
    if ballot.answers.keys() != showings or len(ballot.votes) != len(showings):
        known = len(ballot.answers.keys() & showings)
        raise InputError(
            f"{path} answers {known} of the {len(showings)} showings of its round: only whole "
            "files count"
        )
