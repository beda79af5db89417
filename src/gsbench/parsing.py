"""Reading the small files that gsbench writes, whoever wrote or broke them since: bounded, and plain values alone.

A file is read if it is a regular one of at most `MOST_BYTES`; nothing else is opened, so that a FIFO or a device holds
nobody up, and no link is followed: a user's own file is read by its `resolved` path. What it holds is JSON or YAML of
at most `MOST_DEPTH` levels, whose numbers are finite.
"""

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml
from pydantic_core import from_json

from gsbench.errors import InputError
from gsbench.files import open_plain

MOST_BYTES = 64 << 20  # the plan of 80,000 trials; a training that logs each of 300,000 iterations
SPARE = 1 << 16  # bytes that are read at once beyond a file's size
MOST_YAML_BYTES = 1 << 20  # a configuration has 2 to 10 kB, and its parser takes a second for this much
MOST_DEPTH = 40  # levels of nesting: ours have up to six, and what a user's class is given adds a few
MOST_WORD = 4000  # characters of plain YAML: what could be a number
MOST_VALUES = 100_000  # of YAML, whose aliases let a few lines stand for billions
MOST_OF_LINE = 300  # characters of a message about a file
LARGEST_INT = 2**64  # beyond the seeds of torch and times in ns
KEYS = {str, int}
LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class DamagedError(InputError):
    """A file of ours cannot be read, or is not what it ought to be; ``reason`` says why without its name."""

    def __init__(self, path: Path, reason: str) -> None:
        self.path, self.reason = path, one_line(reason)
        super().__init__(f"{path} {self.reason}")


def one_line(text: str) -> str:
    """A text for people, whatever a file or a library put into it."""
    line = " ".join(text.split())
    return line if len(line) <= MOST_OF_LINE else f"{line[:MOST_OF_LINE]}…"


def read_bytes(path: Path, most: int = MOST_BYTES) -> bytes:
    """The content of a regular file; raises DamagedError for any other, and FileNotFoundError where there is none."""
    with _opened(path) as descriptor:
        content = _read_up_to(descriptor, most + 1)
    if len(content) > most:
        raise DamagedError(path, f"cannot be read: it has more than {most:,} bytes")
    return content


def read_tail(path: Path, count: int) -> bytes:
    """The last ``count`` bytes of a regular file; raises as `read_bytes` does."""
    with _opened(path) as descriptor:
        os.lseek(descriptor, max(0, os.fstat(descriptor).st_size - count), os.SEEK_SET)
        return os.read(descriptor, count)


def resolved(path: Path) -> Path:
    """The place that a user's own ``path`` leads to, by whatever links."""
    return Path(os.path.realpath(path))


@contextmanager
def _opened(path: Path) -> Iterator[int]:
    """A descriptor of a regular file, closed afterwards; what goes wrong meanwhile is said of the file."""
    try:
        if not stat.S_ISREG(os.lstat(path).st_mode):  # a link is none: see `gsbench.files.require_own`
            raise DamagedError(path, "cannot be read: it is not a regular file")
        descriptor = open_plain(path)
        try:
            yield descriptor
        finally:
            os.close(descriptor)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise FileNotFoundError(*error.args) from None
    except InputError:
        raise
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise DamagedError(path, f"cannot be read ({getattr(error, 'strerror', None) or error})") from None


def _read_up_to(descriptor: int, most: int) -> bytes:
    """At most ``most`` bytes: by one call where the file is as long as it says, which those of ``/proc`` are not."""
    content = os.read(descriptor, min(most, os.fstat(descriptor).st_size + 1))
    parts = [content]
    while (left := most - sum(map(len, parts))) > 0 and (part := os.read(descriptor, min(left, SPARE))):
        parts.append(part)
    return b"".join(parts)


def read_json(path: Path) -> Any:
    """The plain value in a JSON file; raises as `read_bytes` does, and DamagedError for what `fault_of` finds."""
    content = read_bytes(path)
    try:
        value = from_json(content)
    except ValueError as error:
        raise DamagedError(path, f"is not JSON ({error})") from None
    if fault := fault_of(value):
        raise DamagedError(path, f"is damaged: {fault}")
    return value


def read_yaml(path: Path, unique: bool = False) -> Any:
    """The plain value in a YAML file; raises as `read_json` does.

    With ``unique``, also for a key that stands twice in a mapping, of which the first would be lost without a word.
    """
    return parse_yaml(read_bytes(path, MOST_YAML_BYTES), path, unique)


def parse_yaml(content: bytes, path: Path, unique: bool = False) -> Any:
    """Parse YAML; raises DamagedError for what is none, or has values that `fault_of` names.

    Numbers need not be finite: YAML is what users set, and a class may have an infinite default. ``unique`` is as
    for `read_yaml`.
    """
    try:
        text = content.decode("utf-8")
        fault = _danger_in_yaml(text) or (_key_that_stands_twice(text) if unique else "")
        value = None if fault else yaml.load(text, Loader=LOADER)
    except (yaml.YAMLError, ValueError, TypeError, OverflowError, RecursionError) as error:
        reason = getattr(error, "problem", None) or error  # PyYAML's own text has several lines
        raise DamagedError(path, f"is not YAML ({reason})") from None
    if fault := fault or fault_of(value, MOST_VALUES, infinite=True):
        raise DamagedError(path, f"is damaged: {fault}")
    return value


def _danger_in_yaml(text: str) -> str:
    """Name what of YAML must not reach its loader: depth (it goes down by recursion in C), merges that multiply,
    numbers whose digits take hours; "" where there is nothing."""
    level = 0
    for event in yaml.parse(text, Loader=LOADER):
        if getattr(event, "tag", None) is not None:
            return f"it has the tag {event.tag}"
        if isinstance(event, yaml.CollectionStartEvent):
            level += 1
            if level > MOST_DEPTH:
                return f"it has more than {MOST_DEPTH} levels"
        elif isinstance(event, yaml.CollectionEndEvent):
            level -= 1
        elif isinstance(event, yaml.ScalarEvent) and event.implicit[0]:  # a plain word, which may become anything
            if event.value == "<<":
                return "it has a merge key"
            if len(event.value) > MOST_WORD:
                return f"it has a word of {len(event.value):,} characters without quotes"
    return ""


def _key_that_stands_twice(text: str) -> str:
    """Name the first key of a mapping that stands there again, with its line; "" where there is none."""
    waiting, seen = [yaml.compose(text, Loader=LOADER)], set()
    while waiting:
        node = waiting.pop()
        if id(node) in seen:  # an alias
            continue
        seen.add(id(node))
        if isinstance(node, yaml.MappingNode):
            keys = set()
            for key, value in node.value:
                if isinstance(key, yaml.ScalarNode):
                    if key.value in keys:
                        return f"{key.value!r} is in it twice (line {key.start_mark.line + 1})"
                    keys.add(key.value)
                waiting.append(value)
        elif isinstance(node, yaml.SequenceNode):
            waiting += node.value
    return ""


def fault_of(value: Any, most: int | None = None, infinite: bool = False) -> str:
    """The reason why ``value`` is not plain, "" where it is: keys are texts or integers, levels at most `MOST_DEPTH`.

    ``most`` is how many values it may have, an alias of YAML counted as often as it stands there. Numbers are finite
    unless ``infinite``.
    """
    level, count = [value], 0
    for _ in range(MOST_DEPTH):
        below: list[Any] = []
        for item in level:
            kind = type(item)
            if kind is dict:
                if _fault_of_keys(item):
                    return _named_fault(value)
                below += item.values()
            elif kind is list:
                below += item
            elif _fault_of_leaf(item) and not (infinite and type(item) is float):
                return _named_fault(value)
            if most is not None and count + len(below) > most:
                return f"it has more than {most:,} values"
        count += len(below)
        if not below:
            return ""
        level = below
    return f"it has more than {MOST_DEPTH} levels"


def _named_fault(value: Any, place: str = "", depth: int = 0) -> str:
    """The first key or number that is none, with its place; "" where there is none above `MOST_DEPTH`."""
    if not isinstance(value, dict | list) or depth > MOST_DEPTH:
        fault = _fault_of_leaf(value)
        return f"{place or 'it'} is {fault}" if fault else ""
    if isinstance(value, dict) and (fault := _fault_of_keys(value)):
        return f"{place or 'it'} has {fault}"
    entries = value.items() if isinstance(value, dict) else enumerate(value)
    found = (_named_fault(item, f"{place}.{key}" if place else str(key), depth + 1) for key, item in entries)
    return next((fault for fault in found if fault), "")


def _fault_of_leaf(item: Any) -> str:
    kind = type(item)
    if kind is str:
        return "" if item.isascii() or _is_unicode(item) else "a text with half a character"
    if kind is float:
        return "" if item - item == 0 else f"{item}, which is not a finite number"
    if kind is int:
        return "" if -LARGEST_INT < item < LARGEST_INT else "an integer beyond all bounds"
    return "" if kind is bool or item is None else f"of type {kind.__name__}"


def _fault_of_keys(mapping: dict[Any, Any]) -> str:
    kinds = set(map(type, mapping))
    if len(kinds) > 1 or not kinds <= KEYS:  # sorted JSON needs them of one kind
        return "keys that are not all texts, or all integers"
    if kinds == {str} and all(map(str.isascii, mapping)):
        return ""
    return next((f"a key that is {fault}" for key in mapping if (fault := _fault_of_leaf(key))), "")


def _is_unicode(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True
