"""Parsing of a verb's words by argparse, with gsbench's errors of one line."""

import argparse
import re
from pathlib import Path
from typing import Any, NoReturn

from gsbench.errors import InputError
from gsbench.words import closest, is_path

MAX_PORT = 65535
SETTING = re.compile(r"[+~]*[a-z_]\w*([./]\w+)*=")


class ArgumentParser(argparse.ArgumentParser):
    """An argparse parser that raises InputError for what it does not understand; ``--help`` prints and exits."""

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        words = list(args or [])
        typed = [word for word in words if word.lstrip("+").startswith("allow_targets=")]
        found, unknown = self.parse_known_args([word for word in words if word not in typed], namespace)
        takers = [action.dest for action in self._actions if not action.option_strings and "=" in str(action.metavar)]
        if takers:  # settings count wherever they stand: argparse takes them in one row alone, or for an option's value
            typed += [word for word in unknown if SETTING.match(word)]
            setattr(found, takers[0], [*getattr(found, takers[0]), *typed])
            unknown = [word for word in unknown if not SETTING.match(word)]
        else:
            unknown += typed
        if unknown:
            options = [option for action in self._actions for option in action.option_strings]
            nears = (closest(word.partition("=")[0], options) for word in unknown if word.startswith("--"))
            self.error(f"unrecognized arguments: {' '.join(unknown)}{next(filter(None, nears), '')}")
        return found

    def error(self, message: str) -> NoReturn:
        verb = self.prog.removeprefix("gsbench").strip()
        raise InputError(f"{verb}{': ' if verb else ''}{message} (see {self.prog} --help)")


def port(text: str) -> int:
    """A TCP port, 0 for any free one; an argument's ``type``."""
    if not text.isascii() or not text.isdigit() or int(text) > MAX_PORT:
        raise argparse.ArgumentTypeError(f"must be a number from 0 to {MAX_PORT}, got {text!r}")
    return int(text)


def path(text: str) -> Path:
    """A path that is not empty, with ``~`` in place; an argument's ``type``."""
    if not is_path(text):
        raise argparse.ArgumentTypeError(f"{text!r} is not a path")
    return Path(text).expanduser()


def add_question(parser: argparse.ArgumentParser) -> None:
    """Add the words that say what is trained, and what decides."""
    parser.add_argument("settings", nargs="*", metavar="KEY=VALUE", help="of the trials, as of a sweep; no seeds")
    parser.add_argument("--metric", default="psnr", help="decides: psnr (the default), lpips_squeeze, gaussians, …")
    parser.add_argument("--least", help="the least difference that matters, as 0.1 or 10%%; default: the metric's")


def add_where(parser: argparse.ArgumentParser) -> None:
    """Add ``--where KEY=VALUE``, whose values `gsbench.analysis.cells.select_trials` takes as a dict."""
    parser.add_argument(
        "--where",
        type=_condition,
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="only such trials (repeatable)",
    )


def _condition(text: str) -> tuple[str, str]:
    key, sign, value = text.partition("=")
    if not sign:
        raise argparse.ArgumentTypeError(f"{text!r} is not KEY=VALUE, such as iterations=30000")
    return key, value


def names(text: str) -> tuple[str, ...]:
    """Different names with commas between them; an argument's ``type``."""
    words = tuple(word.strip() for word in text.split(","))
    if not all(words) or len(set(words)) < len(words):
        raise argparse.ArgumentTypeError(f"must be different names, comma between, got {text!r}")
    return words
