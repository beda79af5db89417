"""Parsing of a verb's words by argparse, with gsbench's errors of one line."""

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from pkgutil import resolve_name
from types import MappingProxyType
from typing import Annotated, Any, NoReturn

from annotated_types import Interval
from pydantic import PositiveFloat, TypeAdapter, ValidationError

from gsbench.errors import InputError
from gsbench.parsing import Count
from gsbench.settings import CONFIG, OpenFraction, describe
from gsbench.verbs import VERBS
from gsbench.words import did_you_mean, is_path, split_outside_brackets

Rows = Mapping[str, Any]


class ArgumentParser(argparse.ArgumentParser):
    """An argparse parser that raises InputError for what it does not understand.

    ``rows`` are its arguments, as ``verbs.yaml`` describes them.
    """

    def __init__(self, rows: Rows, verb: str = "", **options: Any):
        super().__init__(prog=f"gsbench {verb}".strip(), **options)
        for words, row in rows.items():
            self._add(words, *((row,) if isinstance(row, str) else row))

    def _add(self, words: str, meaning: str, read: Any = "text", default: Any = None) -> None:
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
            if isinstance(read, str):
                read = READERS[read] if read in READERS else resolve_name(read)
            how |= {"default": [] if own == "*" else default}
            how |= (
                {"type": read, "metavar": shown or name} if callable(read) else {"choices": [*read]}
            )
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
    """The reader of a number as an annotation allows."""
    adapter = TypeAdapter(hint, config=CONFIG)

    def read(text: str) -> Any:
        try:
            return adapter.validate_python(text)
        except ValidationError:
            raise argparse.ArgumentTypeError(f"must be {describe(hint)}, got {text!r}") from None

    return read


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


def names(text: str) -> tuple[str, ...]:
    """Different names, such as ``adc,momentum[decay=0.9, lr=1]``; an argument's ``type``."""
    words = tuple(word.strip() for word in split_outside_brackets(text, ","))
    if not all(words) or len(set(words)) < len(words):
        raise argparse.ArgumentTypeError(f"must be different names, comma between, got {text!r}")
    return words


_count = number(Annotated[int, Interval(ge=1, le=1_000_000_000)])
READERS: dict[str, Callable[[str], Any]] = {
    "text": str,
    "int": int,
    "path": path,
    "names": names,
    "condition": _condition,
    "count": _count,
    "counts": comma_separated(_count),
    "seeds": comma_separated(number(Count)),
    "to_10000": number(Annotated[int, Interval(ge=1, le=10_000)]),
    "port": number(Annotated[int, Interval(ge=0, le=65535)]),  # of TCP; 0: any free one
    "rate": number(OpenFraction),
    "difference": number(PositiveFloat),
}


def options_of(verb: str, argv: Sequence[str], rows: Rows = MappingProxyType({})) -> Any:
    """The words ``argv`` of a verb, by its arguments in ``verbs.yaml`` and further ``rows``.

    ``gsbench VERB --help`` prints its purpose and the rest, and exits.
    """
    known = VERBS[verb]
    purpose = known["purpose"]
    stop = "" if purpose.endswith("?") else "."
    description = f"{purpose[:1].upper()}{purpose[1:]}{stop} {known.get('more', '')}"
    parser = ArgumentParser({**known["arguments"], **rows}, verb, description=description)
    return parser.parse_args(argv)
