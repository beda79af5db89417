"""Parsing of a verb's words by argparse, with gsbench's errors of one line."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NoReturn

from annotated_types import Interval
from pydantic import TypeAdapter, ValidationError

from gsbench.errors import InputError
from gsbench.settings import CONFIG, describe
from gsbench.verbs import VERBS
from gsbench.words import did_you_mean, is_path, split_outside_brackets


class ArgumentParser(argparse.ArgumentParser):
    """An argparse parser that raises InputError for what it does not understand.

    ``gsbench VERB --help`` prints the verb's purpose and the text ``more``, and exits.
    """

    def __init__(self, verb: str = "", more: str = "", **options: Any) -> None:
        purpose = VERBS[verb][1] if verb else ""
        stop = "" if purpose.endswith("?") else "."
        description = f"{purpose[:1].upper()}{purpose[1:]}{stop} {more}"
        super().__init__(prog=f"gsbench {verb}".strip(), description=description, **options)

    def flag(self, name: str, meaning: str) -> None:
        """Add an option without a value, False unless given."""
        self.add_argument(name, action="store_true", help=meaning)

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


def add_question(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that say what is trained, and which metric decides."""
    parser.add_argument(
        "settings", nargs="*", metavar="KEY=VALUE", help="of the trials, as of a sweep; no seeds"
    )
    parser.add_argument(
        "--metric", default="psnr", help="decides: psnr (the default), lpips_squeeze, gaussians, …"
    )
    parser.add_argument(
        "--least", help="the least difference that matters, as 0.1 or 10%%; default: the metric's"
    )


def add_where(parser: argparse.ArgumentParser) -> None:
    """Add ``--where KEY=VALUE``; `gsbench.analysis.cells.select_trials` takes a dict of them."""
    parser.add_argument(
        "--where",
        type=_condition,
        action="append",
        default=[],
        metavar="KEY=A,B",
        help="only trials with one of these values (repeatable)",
    )


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
