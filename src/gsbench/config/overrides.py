"""One word of a command, an override of Hydra's: parsing it, its key, its value as text."""

import re
import shlex
from collections.abc import Iterable, Sequence
from functools import cache
from itertools import accumulate

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException

from gsbench.errors import InputError

MAX_BRACKETS = 40  # open at once in a word, since Hydra's parser recurses into them
KEY = re.compile(r"[+~]*\w+([./]\w+)*")


def task_words(words: Iterable[str]) -> list[str]:
    """The words for the trials, which Hydra calls task overrides: those not for Hydra itself."""
    return [word for word in words if not parse_word(word).is_hydra_override()]


@cache
def parse_word(word: str) -> Override:
    """Parse a word as Hydra does. Raises InputError unless it is ``key=value`` or ``~key``."""
    if "=" not in word and not word.startswith("~"):
        raise InputError(f"{word!r} is not a setting like key=value")
    open_at_once = accumulate(((letter in "[{(") - (letter in "]})") for letter in word), initial=0)
    if max(open_at_once) > MAX_BRACKETS:
        raise InputError(
            f"{word[:40]!r}… opens more than {MAX_BRACKETS} brackets within each other"
        )
    try:
        override = OverridesParser.create().parse_override(word)
    except ValueError as error:  # such as a number with more digits than Python converts
        raise InputError(f"{word[:40]!r}… is not a setting like key=value ({error})") from None
    except HydraException as error:
        reason = re.sub(r",? expecting .*", "", str(error).splitlines()[0])
        raise InputError(
            f"{word!r} is not a setting like key=value ({reason}){_quoted(word)}"
        ) from error
    if not override.key_or_group.strip():
        raise InputError(f"{word!r} names no setting")
    return override


def key_of(word: str) -> str:
    """The setting that a word sets, adds or removes."""
    return bare_key(parse_word(word).get_key_element())


def changed_words(words: Sequence[str], changes: Sequence[str]) -> list[str]:
    """The words with ``changes``: each replaces the word of its key, and ``~KEY`` removes that.

    Another launcher or tracker takes no settings that were meant for the one before.
    """
    others = {key_of(word) for word in changes if word not in words} & {"launch", "tracking"}
    own = {key_of(word): word for word in words if key_of(word).partition(".")[0] not in others}
    for word in changes:
        if own.pop(key_of(word), None) is None or not word.startswith("~"):
            own[key_of(word)] = word
    return list(own.values())


def bare_key(key: str) -> str:
    """A key without the signs that add or remove it."""
    return key.lstrip("+~")


def value_text(value: object) -> str:
    """The text of a plain value in a word, such as ``null``, ``true`` or ``[1,2]``."""
    if isinstance(value, list):
        return f"[{','.join(map(value_text, value))}]"
    return (
        "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)
    )


def _quoted(word: str) -> str:
    """A hint to quote the word's value, whose characters mean something to Hydra."""
    key, _, value = word.partition("=")
    if not KEY.fullmatch(key):
        return ""
    function = re.fullmatch(r"(\w+)\((.*)\)", value)
    if function and function.group(1) != "glob":
        return ""  # in quotes it would be a text, not a list of values
    start, value, end = (
        (f"{key}=glob(", function.group(2), ")") if function else (f"{key}=", value, "")
    )
    quoted = f"{start}'{value}'{end}" if '"' in value else f'{start}"{value}"{end}'
    return (
        "; special characters need their own quotes inside those of the shell: "
        f"{shlex.quote(quoted)}"
    )


def is_sweep(word: str) -> bool:
    """Return whether a word lists several values."""
    return parse_word(word).is_sweep_override()
