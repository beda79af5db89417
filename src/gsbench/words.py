"""Numbers as people say them, the nearest right word for a wrong one, and what can be a path."""

import difflib
import re
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePath

MAX_NAMED = 3  # names that an error or warning lists before it only counts
# Characters that a terminal obeys in place of showing: control characters, but for line feed and tab; line separators;
# marks that turn the direction of writing (UAX #9); halves of characters, which names of files may have.
OBEYED = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")

# A path from the root or the home folder within a sentence, up to a blank or what ends the naming of one.
PLACE = re.compile(r"""(?<![^\s=(['"`])(?:~[\w.-]*)?/[^\s,;:'"`)\]]+""")


def counted(count: int, noun: str) -> str:
    """``1 trial``, ``2 trials``."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def readable_time(seconds: float) -> str:
    """Seconds as people say them."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 90 * 60:
        return f"{seconds / 60:.0f} min"
    if seconds < 36 * 3600:
        return f"{seconds / 3600:.1f} h"
    return f"{seconds / 86400:.1f} days"


def signed(value: float, spec: str) -> str:
    """A number with its sign and a true minus, as ``spec`` formats it (``.2f``, ``.1%``): +0.50, −3.0%."""
    return true_minus(f"{value:+{spec}}")


def true_minus(number: str) -> str:
    """A formatted number with the minus sign of print in the place of the hyphen."""
    return number.replace("-", "−")


def closest(word: str, choices: Iterable[str]) -> str:
    """'; did you mean X?' where one choice is near, else ''."""
    choices = list(choices)
    near = difflib.get_close_matches(word, choices, n=1) or difflib.get_close_matches(word.lower(), choices, n=1)
    return f"; did you mean {near[0]}?" if near else ""


def readable_bytes(count: int | None) -> str:
    """Bytes as people say them, in powers of ten; ``unknown size`` for None."""
    if count is None:
        return "unknown size"
    for unit, size in (("GB", 10**9), ("MB", 10**6), ("kB", 10**3)):
        if count >= size:
            return f"{count / size:.3g} {unit}"
    return f"{count} bytes"


def without_places(text: str) -> str:
    """The text, with the last name of each path of this machine in its place.

    Examples:
        >>> without_places("weights not found (looked in /home/me/weights, ~/.cache/torch; no /): see https://a.org/b")
        'weights not found (looked in weights, torch; no /): see https://a.org/b'
    """
    return PLACE.sub(lambda found: PurePath(found[0]).name, text)


def is_path(value: str) -> bool:
    """Return whether a text can be a path: not empty, no control characters, no ``~user`` that is not known."""
    try:
        return value.strip() != "" and value.isprintable() and bool(Path(value).expanduser())
    except RuntimeError:
        return False


def printable(text: str) -> str:
    """``text`` with its control characters written out, so that a terminal shows them and obeys none.

    Examples:
        >>> printable("red \\x1b[31m")
        'red \\\\x1b[31m'
    """
    return OBEYED.sub(lambda found: found[0].encode("unicode_escape").decode("ascii"), text.replace("\r\n", "\n"))


def listed(names: Sequence[str]) -> str:
    """``a``, ``a and b``, ``a, b and c``."""
    return " and ".join(filter(None, [", ".join(names[:-1]), *names[-1:]]))


def some_of(names: Sequence[str]) -> str:
    """The first few names and the count of the others, for messages."""
    more = len(names) - MAX_NAMED
    return ", ".join(names[:MAX_NAMED]) + (f" and {more} more" if more > 0 else "")
