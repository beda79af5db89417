"""The trials of a ledger's words: which settings an idea may have, and what may run."""

from collections.abc import Sequence

from gsbench.analysis.questions import FIRST_LOOK
from gsbench.app.command import compose_trials, require_waiting
from gsbench.config.command_words import typed_permissions
from gsbench.config.compose import Trial
from gsbench.config.overrides import key_of
from gsbench.errors import InputError
from gsbench.launch.record import planned_rows
from gsbench.runs.commands import Digest, Idea
from gsbench.words import listed

GIVEN = ("name", "runs", "eval.primary")  # settings that the ledger sets itself
# An idea may change how a model is made, not what it is measured on.
OF_IDEAS = (
    "densify",
    "init",
    "train",
    "raster",
    "allow_targets",
    "launch",
    "device",
    "threads",
    "tracking",
)
Trials = dict[tuple[str, Digest, int], Trial]  # by scene, digest and seed


def compose_words(name: str, words: Sequence[str], typed: Sequence[str]) -> Trials:
    """The trials of words; only the ``typed`` ones give permissions.

    Raises InputError for settings that the ledger sets.
    """
    for word in words:
        if key_of(word) in GIVEN:
            raise InputError(f"ledger: {key_of(word)} follows from the ledger: leave it out")
    trials = compose_trials([*words, f"name={name}"], multirun=True, typed=typed)
    require_waiting("ledger", trials)
    rows = planned_rows(trials)
    return {(row.scene, row.digest, row.seed): one for row, one in zip(rows, trials, strict=True)}


def digests_of(trials: Trials, name: str) -> dict[str, Digest]:
    """The digest on each scene; raises InputError for several arms."""
    digests = {scene: digest for scene, digest, _ in trials}
    if any(digests[scene] != digest for scene, digest, _ in trials):
        raise InputError(f"{name} compares one arm at a time: only scene and seed may list values")
    return digests


def seeds_of(trials: Trials) -> tuple[int, ...]:
    seeds = tuple(dict.fromkeys(seed for _, _, seed in trials))
    if len(seeds) < FIRST_LOOK:
        raise InputError(f"a ledger needs at least {FIRST_LOOK} seeds, such as seed=0,1,2,3,4,5")
    return seeds


def permitted_words(idea: Idea, typed: Sequence[str]) -> tuple[str, ...]:
    """The recorded settings of an idea, with what is typed about tracking.

    Raises InputError if they would run code that the ``typed`` words do not allow: the ledger is a
    file, and may be somebody else's.
    """
    words = idea.words
    needed = set(typed_permissions(words)) - set(typed_permissions(typed))
    if needed:
        names = ",".join(sorted(needed | set(typed_permissions(typed))))
        raise InputError(f"{idea.name} runs code of yours: add allow_targets=[{names}]")
    tracking = [word for word in typed if key_of(word).partition(".")[0] == "tracking"]
    if any(key_of(word) == "tracking" for word in tracking):  # settings of another tracker
        words = tuple(word for word in words if not key_of(word).startswith("tracking"))
    return tuple(merged(words, tracking))


def merged(words: Sequence[str], changes: Sequence[str]) -> list[str]:
    """The words with ``changes``: each replaces the word of the same key, ``~KEY`` removes it."""
    given, changed = set(map(key_of, words)), set(map(key_of, changes))
    kept = [word for word in words if key_of(word) not in changed]
    return kept + [word for word in changes if not (word.startswith("~") and key_of(word) in given)]


def check_words(words: Sequence[str]) -> None:
    """Raise InputError for a setting that an idea may not change, and for no settings at all."""
    for key in map(key_of, words):
        if key.partition(".")[0].partition("/")[0] not in OF_IDEAS:
            raise InputError(f"{key}: an idea may change {listed(OF_IDEAS[:4])}, not what decides")
    if not words:
        raise InputError("ledger try needs the idea's settings, such as densify=volumetric")
