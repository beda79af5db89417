"""Commands of other programs, in which ``{name}`` stands for what is known when they run. Loads no torch."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable, Mapping, Sequence

from gsbench.errors import InputError
from gsbench.words import closest

PLACEHOLDER = re.compile(r"\{(\w+)\}")
Command = str | Sequence[str]  # one text is split as a shell would; none is run


def words_of(command: Command, key: str) -> list[str]:
    """A command's words; the setting ``key`` is named in errors. Raises InputError for an empty one, or open quotes."""
    try:
        words = shlex.split(command) if isinstance(command, str) else [str(word) for word in command]
    except ValueError as error:
        raise InputError(f"{key} cannot be split into words ({error}): write it as a list") from error
    if not words or not words[0]:
        raise InputError(f"{key} is empty: name the program to run")
    return words


def program_of(command: Command, options: Mapping[str, object], key: str = "densify.command") -> str:
    """The program that the setting ``key`` runs: its first word, in which ``options`` may stand."""
    return fill(words_of(command, key)[0], options, key)


def names_in(texts: Iterable[str]) -> set[str]:
    """The placeholders that stand in ``texts``."""
    return {name for text in texts for name in PLACEHOLDER.findall(text)}


def fill(text: str, values: Mapping[str, object], key: str) -> str:
    """``text`` with every placeholder replaced once. Raises InputError, naming ``key``, for one that is not known."""

    def value(match: re.Match[str]) -> str:
        name = match[1]
        if name not in values:
            there = ", ".join(f"{{{known}}}" for known in values)
            raise InputError(f"{key}: nothing is known as {{{name}}}{closest(name, values)} (there are {there})")
        return str(values[name])

    return PLACEHOLDER.sub(value, text)
