"""Parsing of a verb's words by argparse, with gsbench's errors of one line."""

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, NoReturn

from annotated_types import Interval
from pydantic import TypeAdapter, ValidationError

from gsbench.errors import InputError
from gsbench.settings import CONFIG, describe
from gsbench.verbs import VERBS
from gsbench.words import did_you_mean, is_path, split_outside_brackets

Rows = Mapping[str, str | tuple[Any, ...]]


class ArgumentParser(argparse.ArgumentParser):
    """An argparse parser that raises InputError for what it does not understand.

    ``gsbench VERB --help`` prints the verb's purpose and the text ``more``, and exits. ``rows``
    give each word its meaning, or its meaning, a function that reads the text (or a list of
    choices) and a default: ``--name VALUE``, a flag ``--name``, and ``name SHOWN`` for a word
    without a flag. ``name?`` may lack, there may be many of ``name*``, and ``--name=own`` is called
    ``own``.
    """

    def __init__(self, verb: str = "", more: str = "", rows: Rows | None = None, **options: Any):
        purpose = VERBS[verb][1] if verb else ""
        stop = "" if purpose.endswith("?") else "."
        description = f"{purpose[:1].upper()}{purpose[1:]}{stop} {more}"
        super().__init__(prog=f"gsbench {verb}".strip(), description=description, **options)
        for words, row in (rows or {}).items():
            self._add(words, *((row,) if isinstance(row, str) else row))

    def _add(self, words: str, meaning: str, read: Any = str, default: Any = None) -> None:
        name, _, shown = words.partition(" ")
        name, own = name.rstrip("?*+"), name[-1]
        how: dict[str, Any] = {"help": meaning}
        if name.startswith("-"):
            name, _, dest = name.partition("=")
            how |= {"dest": dest} if dest else {}
            how |= {"action": "append"} if own == "*" else {}
        elif own in "?*+":
            how["nargs"] = own
        if name.startswith("-") and not shown:
            how["action"] = "store_true"
        else:
            how |= {"default": [] if own == "*" else default}
            how |= {"type": read, "metavar": shown or name} if callable(read) else {"choices": read}
        self.add_argument(name, **how)

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        # Settings may stand anywhere on the line, and permissions also before the first positional
        # word.
        words = sorted(args or [], key=lambda word: word.lstrip("+").startswith("allow_targets="))
        parsed, unknown = self.parse_known_intermixed_args(words, namespace)
        if unknown:
            known = list(self._option_string_actions)
            wrong = [word.partition("=")[0] for word in unknown if word.startswith("--")]
            hints = filter(None, (did_you_mean(option, known) for option in wrong))
            self.error(f"unrecognized arguments: {' '.join(unknown)}{next(hints, '')}")
        return parsed

    def error(self, message: str) -> NoReturn:
        verb = self.prog.removeprefix("gsbench").strip()
        raise InputError(f"{verb}{': ' if verb else ''}{message} (see {self.prog} --help)")


def number(hint: Any) -> Callable[[str], Any]:
    """The reader of a number as an annotation allows; an argument's ``type``."""
    adapter = TypeAdapter(hint, config=CONFIG)

    def read(text: str) -> Any:
        try:
            return adapter.validate_python(text)
        except ValidationError:
            raise argparse.ArgumentTypeError(f"must be {describe(hint)}, got {text!r}") from None

    return read


port = number(Annotated[int, Interval(ge=0, le=65535)])  # of TCP; 0: any free one


def whole_number(most: int) -> Callable[[str], Any]:
    """The reader of a whole number from 1 to ``most``."""
    return number(Annotated[int, Interval(ge=1, le=most)])


def comma_separated(read: Callable[[str], Any]) -> Callable[[str], list[Any]]:
    """The reader of values with commas between."""
    return lambda text: [read(part) for part in text.split(",")]


def path(text: str) -> Path:
    """A path, with ``~`` expanded; an argument's ``type``."""
    if not is_path(text):
        raise argparse.ArgumentTypeError(f"{text!r} is not a path")
    return Path(text).expanduser()


def _condition(text: str) -> tuple[str, str]:
    key, sign, value = text.partition("=")
    if not sign:
        raise argparse.ArgumentTypeError(f"{text!r} is not KEY=VALUE, such as iterations=30000")
    return key, value


WHERE = {  # `gsbench.analysis.cells.select_trials` takes a dict of them
    "--where* KEY=A,B": ("only trials with one of these values (repeatable)", _condition)
}


def names(text: str) -> tuple[str, ...]:
    """Different names, such as ``adc,momentum[decay=0.9, lr=1]``; an argument's ``type``."""
    words = tuple(word.strip() for word in split_outside_brackets(text, ","))
    if not all(words) or len(set(words)) < len(words):
        raise argparse.ArgumentTypeError(f"must be different names, comma between, got {text!r}")
    return words
