"""Text for people: readable numbers, lists of names, suggestions for wrong words, safe output."""

import ast
import difflib
import re
import shlex
import string
import traceback
import unicodedata
from collections.abc import Iterable, Sequence
from dataclasses import fields
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any

MAX_NAMED = 3  # names that a message lists; further ones are only counted
# Share of letters that two names have in common, from which one may be meant for the other. A slip
# in a setting leaves .66 and more; unlike settings, such as downscale and depth_scale, reach .64.
LIKE = 0.65
# Characters that a terminal acts on instead of showing: control characters except line feed and
# tab, line separators, marks that change the direction of writing (UAX #9), and surrogates, which
# file names may contain.
CONTROL_CHARACTERS = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]"
)

# A path within a sentence that starts at the root or a home folder, up to a blank, a quote, a
# bracket or punctuation.
PATH_IN_TEXT = re.compile(r"""(?<![^\s=(['"`])(?:~[\w.-]*)?/[^\s,;:'"`)\]]+""")


def counted(count: int, noun: str) -> str:
    """A number with its noun: ``1 trial``, ``2 trials``."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def split_outside_brackets(text: str, mark: str) -> list[str]:
    """The parts of ``text`` between ``mark``; a value in brackets may have the mark itself."""
    parts, depth = [""], 0
    for letter in text:
        depth += (letter in "[{(") - (letter in "]})")
        if letter == mark and depth == 0:
            parts.append("")
        else:
            parts[-1] += letter
    return parts


def value_words(text: str) -> str:
    """A setting's value, as ``str`` gives it, in a few words: objects by their classes and options.

    A user's class keeps the name of its module, since several modules may have a class ``Term``.

    Examples:
        >>> value_words("[{'_target_': 'my.a.B'}, {'_target_': 'gsbench.eval.C', 'weight': 0.1}]")
        'a.B + C(weight=0.1)'
    """
    if "_target_" not in text:
        return text
    try:
        return _object_words(ast.literal_eval(text))
    except (ValueError, SyntaxError):
        return text


def _object_words(value: Any) -> str:
    if isinstance(value, list):
        return " + ".join(map(_object_words, value))
    if not isinstance(value, dict) or "_target_" not in value:
        return str(value)
    path = str(value["_target_"]).split(".")
    options = [f"{key}={_object_words(own)}" for key, own in value.items() if key != "_target_"]
    name = ".".join(path[-1:] if path[0] == "gsbench" else path[-2:])
    return f"{name}({', '.join(options)})" if options else name


def readable_time(seconds: float) -> str:
    """Seconds in a readable unit."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 90 * 60:
        return f"{seconds / 60:.0f} min"
    if seconds < 36 * 3600:
        return f"{seconds / 3600:.1f} h"
    return f"{seconds / 86400:.1f} days"


def least_text(least: float, relative: bool) -> str:
    """A least difference that matters: ``0.005``, or ``10 %`` if it is ``relative``."""
    return f"{100 * least:g} %" if relative else f"{least:g}"


def signed(value: float, spec: str) -> str:
    """A number with its sign, formatted by ``spec`` (``.2f``, ``.1%``): ``+0.50``, ``−3.0%``."""
    return true_minus(f"{value:+{spec}}")


def true_minus(number: str) -> str:
    """A formatted number with a minus sign instead of the hyphen."""
    return number.replace("-", "−")


def did_you_mean(word: str, choices: Iterable[str]) -> str:
    """'; did you mean X?' if a choice is similar to ``word``, else ''."""
    choices = list(choices)
    near = difflib.get_close_matches(word, choices, 1, LIKE) or difflib.get_close_matches(
        word.lower(), choices, 1, LIKE
    )
    return f"; did you mean {near[0]}?" if near else ""


class NamesAttributes:
    """Base of dataclasses for a user's code: a wrong attribute's error lists the right ones."""

    if not TYPE_CHECKING:  # else a type checker would allow any name

        def __getattr__(self, name: str) -> Any:
            raise AttributeError(no_such(type(self).__name__, name, attributes_of(type(self))))


def attributes_of(cls: Any) -> list[str]:
    """The fields of a dataclass, then its properties."""
    properties = [name for name, value in vars(cls).items() if isinstance(value, property)]
    return [*(field.name for field in fields(cls)), *properties]


def no_such(owner: str, name: str, names: Sequence[str], inside: str = "") -> str:
    """The message of an AttributeError, with the names that ``owner`` has (``inside`` a field)."""
    guess = did_you_mean(name, names).replace("did you mean ", f"did you mean {inside}")
    return (
        f"{owner} has no {name!r}; it has {', '.join(f'{inside}{known}' for known in names)}{guess}"
    )


def readable_bytes(count: int | None) -> str:
    """Bytes in a readable unit (powers of ten); ``unknown size`` for None."""
    if count is None:
        return "unknown size"
    for unit, size in (("GB", 10**9), ("MB", 10**6), ("kB", 10**3)):
        if count >= size:
            return f"{count / size:.3g} {unit}"
    return f"{count} bytes"


def without_folders(text: str) -> str:
    """The text with each absolute path replaced by its last part.

    Examples:
        >>> without_folders("no weights (looked in /home/me/weights, ~/.cache/torch; no /): see https://a.org/b")
        'no weights (looked in weights, torch; no /): see https://a.org/b'
    """
    return PATH_IN_TEXT.sub(lambda match: PurePath(match[0]).name, text)


def is_path(value: str) -> bool:
    """Return whether a text can be a path.

    It must not be empty, and have neither control characters nor an unknown ``~user``.
    """
    try:
        return value.strip() != "" and value.isprintable() and bool(Path(value).expanduser())
    except RuntimeError:
        return False


def is_one_line(name: str) -> bool:
    """Return whether a name is UTF-8 without control characters and line breaks.

    Python reads bytes of a file's name that are not UTF-8 as surrogates.
    """
    return not any(unicodedata.category(letter) in ("Cc", "Cs", "Zl", "Zp") for letter in name)


def printable(text: str) -> str:
    """``text`` with control characters escaped: a terminal shows them, and does not act on them.

    Examples:
        >>> printable("red \\x1b[31m")
        'red \\\\x1b[31m'
    """
    return CONTROL_CHARACTERS.sub(_escaped, text.replace("\r\n", "\n"))


# Characters that end a line or move the cursor; none of them is in a name that gsbench accepts.
NOT_IN_A_LINE = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029]")
# in Markdown: a tag, the middle of a link or picture, a code span, and a mark of escapes
MARKUP = re.compile(r"<(?=[a-zA-Z/!?])|(?<=\])\(|[`\\]")


def as_line(text: str) -> str:
    """``text`` in one line: line breaks, tabs and control characters are escaped.

    Every text of a record passes through it when it is read (`gsbench.parsing.Record`), so that a
    stranger's name cannot begin a line of its own.

    Examples:
        >>> as_line("psnr\\nVerdict: better")
        'psnr\\\\nVerdict: better'
    """
    if text.isprintable():  # nearly always, and fast
        return text
    return NOT_IN_A_LINE.sub(_escaped, text)


def _escaped(found: re.Match[str]) -> str:
    return found[0].encode("unicode_escape").decode("ascii")


def markdown_text(text: str) -> str:
    """``text`` in one line of Markdown, without HTML, links, pictures and code of its own."""
    return MARKUP.sub(r"\\\g<0>", printable(" ".join(text.split())))


def markdown_code(text: str) -> str:
    """``text`` as code in a line of Markdown: a fence longer than any in it.

    Examples:
        >>> markdown_code("a`b")
        '`` a`b ``'
    """
    text = printable(as_line(text))
    fence = "`" * (1 + max(map(len, re.findall("`+", text)), default=0))
    return f"{fence}{text}{fence}" if len(fence) == 1 else f"{fence} {text} {fence}"


def command(*words: str) -> str:
    """A command of gsbench to type: a stranger's name in it is no word of the shell.

    Examples:
        >>> command("retry", "x; rm y")
        "gsbench retry 'x; rm y'"
    """
    return shlex.join(["gsbench", *words])


def listed(names: Sequence[str]) -> str:
    """Names in a sentence: ``a``, ``a and b``, ``a, b and c``."""
    return " and ".join(filter(None, [", ".join(names[:-1]), *names[-1:]]))


def some_of(names: Sequence[str]) -> str:
    """The first few names and the number of further ones, for messages."""
    more = len(names) - MAX_NAMED
    return ", ".join(names[:MAX_NAMED]) + (f" and {more} more" if more > 0 else "")


class _Form(string.Formatter):
    """The format of facts in sentences.

    ``{count:n trial}`` gives ``2 trials``, ``{names:few}`` the first names and a count of the rest.
    All names come by ``{names:all}`` with "and" before the last, by ``{names:list}`` with commas
    and by ``{names:parts}`` with semicolons. ``{name:if: by %}`` gives `` by NAME``, or nothing if
    the fact is empty.
    """

    def format_field(self, value: Any, spec: str) -> str:
        if spec.startswith("n "):
            return counted(value, spec[2:])
        if spec.startswith("if:"):
            return spec[3:].replace("%", str(value)) if value else ""
        joined = {"few": some_of, "all": listed, "list": ", ".join, "parts": "; ".join}.get(spec)
        return joined([*map(str, value)]) if joined else str(super().format_field(value, spec))


FORM = _Form()


def raised(error: Exception) -> str:
    """The error of a user's code with its place, in one line: ``KeyError 'a' (b.py, line 3)``."""
    frame = traceback.extract_tb(error.__traceback__)[-1]
    message = " ".join(f"{type(error).__name__} {str(error)[:200]}".split())
    return f"{message} ({frame.filename}, line {frame.lineno})"
