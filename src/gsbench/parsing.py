"""Reading of small JSON and YAML files within limits: others may have written or damaged them.

Only regular files of at most `MAX_BYTES` are opened, so that a FIFO or a device cannot block the
reader. Links are not followed; a user's own file is read by its `resolved` path. The content has at
most `MAX_DEPTH` levels and only plain values.
"""

import codecs
import math
import os
import re
import reprlib
import stat
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar, cast, dataclass_transform

import yaml
from annotated_types import MinLen
from pydantic import (
    AfterValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    TypeAdapter,
    ValidationError,
)
from pydantic_core import CoreSchema, ErrorDetails, core_schema, from_json

from gsbench.errors import InputError
from gsbench.files import open_plain
from gsbench.words import as_line

# enough for the plan of 80,000 trials, or a training that logs each of 300,000 iterations
MAX_BYTES = 64 << 20
MAX_YAML_BYTES = 1 << 20  # a configuration has 2 to 10 kB; the parser needs a second for this much
# levels of nesting: gsbench's files have up to six, and arguments of a user's class add a few
MAX_DEPTH = 40
MAX_WORD = 4000  # characters of an unquoted YAML word, which could be a number
MAX_VALUES = 100_000  # in a YAML file, whose aliases let a few lines stand for billions of values
MAX_MESSAGE = 300  # characters of a message about a file
AROUND = 20  # bytes on each side of one that is not UTF-8 that a message shows
LARGEST_INT = 2**64  # larger than the seeds of torch and times in ns
SURROGATE = re.compile("[\ud800-\udfff]")  # half a character, which no file can hold
LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class DamagedError(InputError):
    """Raised for a file of gsbench that cannot be read or has wrong content.

    ``reason`` does not name the file.
    """

    def __init__(self, path: Path, reason: str) -> None:
        self.path, self.reason = path, one_line(reason)
        super().__init__(f"{path} {self.reason}")


def one_line(text: str) -> str:
    """Shorten a text from a file or a library to one line for a message."""
    line = " ".join(text.split())
    return line if len(line) <= MAX_MESSAGE else f"{line[:MAX_MESSAGE]}…"


def read_bytes(path: Path, most: int = MAX_BYTES) -> bytes:
    """The content of a regular file.

    Raises DamagedError for any other file, FileNotFoundError for a missing one.
    """
    with _opened(path) as descriptor, open(descriptor, "rb", 0, closefd=False) as file:
        size = os.fstat(descriptor).st_size
        content = file.read() if size <= most else b""
    if max(size, len(content)) > most:
        raise DamagedError(path, f"cannot be read: it has more than {most:,} bytes")
    return content


def read_tail(path: Path, count: int) -> bytes:
    """The last ``count`` bytes of a regular file; raises as `read_bytes` does."""
    with _opened(path) as descriptor:
        os.lseek(descriptor, max(0, os.fstat(descriptor).st_size - count), os.SEEK_SET)
        return os.read(descriptor, count)


def without_byte_order_mark(content: bytes) -> bytes:
    """The content of a text file without UTF-8's byte order mark.

    Raises InputError for UTF-16 and UTF-32.
    """
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE, codecs.BOM_UTF32_BE)):
        raise InputError("it is UTF-16 or UTF-32: save it as UTF-8")
    return content.removeprefix(codecs.BOM_UTF8)


def text_of(content: bytes) -> str:
    """The text of a user's file; raises InputError with the line and the mend if not UTF-8."""
    content = without_byte_order_mark(content)
    try:
        return content.decode()
    except UnicodeDecodeError as error:
        before, after = content[: error.start], content[error.start :]
        near = before.rpartition(b"\n")[2][-AROUND:] + after.partition(b"\n")[0][:AROUND]
        shown = one_line(near.decode("ascii", "backslashreplace"))
        number = before.count(b"\n") + 1
        raise InputError(f"line {number} is not UTF-8 ({shown}): save it as UTF-8") from error


def resolved(path: Path) -> Path:
    """A user's ``path`` with its links resolved."""
    return Path(os.path.realpath(path))


@contextmanager
def _opened(path: Path) -> Iterator[int]:
    """Yield the descriptor of a regular file.

    Errors within the block become errors that name the file.
    """
    try:
        # refuses links too: see `gsbench.files.require_no_links`
        if not stat.S_ISREG(os.lstat(path).st_mode):
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
        raise DamagedError(
            path, f"cannot be read ({getattr(error, 'strerror', None) or error})"
        ) from None


def read_json(path: Path) -> Any:
    """The value in a JSON file.

    Raises as `read_bytes` does, and DamagedError if `fault_of` finds a fault.
    """
    value = parse_json(read_bytes(path), path)
    if fault := fault_of(value):
        raise DamagedError(path, f"is damaged: {fault}")
    return value


def parse_json(content: bytes, path: Path) -> Any:
    """Parse the JSON ``content`` of the file ``path``, whose values may have faults (`fault_of`).

    Raises DamagedError. The parser refuses more than 200 levels and integers of more than 4,300
    digits.
    """
    try:
        return from_json(content)
    except ValueError as error:
        raise DamagedError(path, f"is not JSON ({error})") from None


def read_yaml(path: Path, loader: Any = None) -> Any:
    """The value in a YAML file, read by `SafeLoader` or a ``loader`` derived from it.

    Raises as `read_bytes` does, and DamagedError if it is no YAML or has a fault. Numbers may be
    infinite, because users write settings in YAML and a class may have an infinite default.
    """
    content = read_bytes(path, MAX_YAML_BYTES)
    try:
        text = content.decode("utf-8")
        fault = _danger_in_yaml(text)
        value = None if fault else yaml.load(text, Loader=loader or SafeLoader)
    except (yaml.YAMLError, ValueError, TypeError, OverflowError, RecursionError) as error:
        reason = getattr(error, "problem", None) or error  # PyYAML's own text has several lines
        raise DamagedError(path, f"is not YAML ({reason})") from None
    if fault := fault or fault_of(value, MAX_VALUES, infinite=True):
        raise DamagedError(path, f"is damaged: {fault}")
    return value


def table_beside(module: str, name: str) -> Any:
    """The YAML file ``name`` of gsbench itself, beside the file ``module``."""
    return yaml.load(Path(module).with_name(name).read_text(encoding="utf-8"), Loader=SafeLoader)


class SafeLoader(LOADER):
    """A safe loader for which a key that occurs twice in a mapping is an error.

    YAML would silently drop the first.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key, _ in node.value:
            name = key.value if isinstance(key, yaml.ScalarNode) else key
            if name in seen:
                raise ValueError(f"{name!r} is in it twice (line {key.start_mark.line + 1})")
            seen.add(name)
        return super().construct_mapping(node, deep)


def _danger_in_yaml(text: str) -> str:
    """Name a construct that must not reach the YAML loader, or "".

    These are tags, deep nesting (the loader recurses in C), merge keys (they multiply), and numbers
    with so many digits that their conversion takes hours.
    """
    level = 0
    for event in yaml.parse(text, Loader=LOADER):
        if getattr(event, "tag", None) is not None:
            return f"it has the tag {event.tag}"
        if isinstance(event, yaml.CollectionStartEvent):
            level += 1
            if level > MAX_DEPTH:
                return f"it has more than {MAX_DEPTH} levels"
        elif isinstance(event, yaml.CollectionEndEvent):
            level -= 1
        # an unquoted word, which may become a number
        elif isinstance(event, yaml.ScalarEvent) and event.implicit[0]:
            if event.value == "<<":
                return "it has a merge key"
            if len(event.value) > MAX_WORD:
                return f"it has a word of {len(event.value):,} characters without quotes"
    return ""


def fault_of(value: Any, most: int | None = None, infinite: bool = False) -> str:
    """The reason why ``value`` is not plain, or "" if it is.

    A plain value has keys that are texts or integers, at most `MAX_DEPTH` levels, finite numbers
    (unless ``infinite``) and at most ``most`` values, where a YAML alias counts each time it is
    used.
    """
    # values still to check, each with its place: the keys that lead there
    containers: deque[tuple[tuple[Any, ...], Any]] = deque([((), [value])])
    count = 0
    while containers:
        place, container = containers.popleft()
        if len(place) > MAX_DEPTH:
            return f"it has more than {MAX_DEPTH} levels"
        count += len(container)
        if most is not None and count > most:
            return f"it has more than {most:,} values"
        is_mapping = isinstance(container, dict)
        if is_mapping and (fault := _fault_of_keys(container)):
            return f"{_named(place)} has {fault}"
        for key, item in container.items() if is_mapping else enumerate(container):
            if type(item) in (dict, list):
                containers.append(((*place, key), item))
            elif (fault := _fault_of_leaf(item)) and not (infinite and type(item) is float):
                return f"{_named((*place, key))} is {fault}"
    return ""


def _named(place: tuple[Any, ...]) -> str:
    return ".".join(map(str, place[1:])) or "it"


def _fault_of_leaf(item: Any) -> str:
    kind = type(item)
    if kind is str:
        is_whole = item.isascii() or not SURROGATE.search(item)  # fast if ASCII
        return "" if is_whole else "a text with a lone surrogate (half a character)"
    if kind is float:
        return "" if math.isfinite(item) else f"{item}, which is not a finite number"
    if kind is int:
        return "" if -LARGEST_INT < item < LARGEST_INT else "an integer of more than 64 bits"
    return "" if kind is bool or item is None else f"of type {kind.__name__}"


def _fault_of_keys(mapping: dict[Any, Any]) -> str:
    kinds = set(map(type, mapping))
    if len(kinds) > 1 or not kinds <= {str, int}:  # JSON with sorted keys needs keys of one type
        return "keys that are not all texts, or all integers"
    return next((f"a key that is {fault}" for key in mapping if (fault := _fault_of_leaf(key))), "")


# ---- JSON files through dataclasses, for writing and reading; the annotations say what is allowed

T = TypeVar("T")

MAX_NUMBER = 1e30  # of a measured value: means and variances of such numbers do not overflow

Number = Annotated[float, Field(ge=-MAX_NUMBER, le=MAX_NUMBER)]
Amount = Annotated[float, Field(ge=0, le=MAX_NUMBER)]
Count = Annotated[int, Field(ge=0, lt=2**63)]
Whole = Annotated[int, Field(gt=-(2**63), lt=2**63)]
Text = Annotated[str, MinLen(1)]
RAW = {"raw": True}


class _AsWritten:
    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.str_schema(metadata=RAW)


# a text of a record as it was written: a path that is opened, or words that are given again
Raw = Annotated[str, _AsWritten]
STRICT = ConfigDict(strict=True, allow_inf_nan=False, extra="ignore")


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(field,))
class Record:
    """Base of records: a subclass is a frozen dataclass of keywords, without a decorator.

    Types are strict and numbers finite; unknown keys are ignored. Every text that is read becomes
    one line (`as_line`), except `Raw` ones: a stranger may have written the file.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return _in_lines(handler(source))

    def __init_subclass__(cls) -> None:
        dataclass(frozen=True, kw_only=True)(cls)

    def to_json(self) -> dict[str, Any]:
        """The JSON object of the file, without optional keys that have their default value."""
        kind: Any = type(self)
        values: dict[str, Any] = adapter(kind).dump_python(self, mode="json")
        return {
            field.name: values[field.name] for field in fields(kind) if not self._has_default(field)
        }

    def _has_default(self, field: Any) -> bool:
        default = field.default if field.default_factory is MISSING else field.default_factory()
        return default is not MISSING and getattr(self, field.name) == default


def _in_lines(schema: Any) -> Any:
    """pydantic's schema of a record, in which each text that is not `Raw` becomes one line.

    Lists and objects of JSON, as Python has them, are accepted as tuples and records.
    """
    if isinstance(schema, list):
        return [_in_lines(item) for item in schema]
    if not isinstance(schema, dict):
        return schema
    if schema.get("type") == "str" and schema.get("metadata") != RAW:
        return core_schema.no_info_after_validator_function(as_line, cast(CoreSchema, schema))
    plain = {"strict": False} if schema.get("type") in ("tuple", "dataclass") else {}
    return {key: _in_lines(value) for key, value in schema.items()} | plain


def lines_in(value: Any) -> Any:
    """A plain value with every text in it, also of keys, as one line."""
    if isinstance(value, dict):
        return {lines_in(key): lines_in(item) for key, item in value.items()}
    if isinstance(value, list):
        return [lines_in(item) for item in value]
    return as_line(value) if isinstance(value, str) else value


# nested plain values of any shape, with texts of one line
Facts = Annotated[dict[str, Any], AfterValidator(lines_in)]


def read_typed(path: Path, kind: type[T]) -> T:
    """The JSON file as an object of ``kind``.

    Raises as `read_bytes` does, and DamagedError naming the first misfit.
    """
    return parse_typed(read_bytes(path), kind, path)


def read_if_sound(path: Path, kind: type[T]) -> T | None:
    """The JSON file as an object of ``kind``, or None if it is missing or damaged."""
    try:
        return read_typed(path, kind)
    except (FileNotFoundError, DamagedError):
        return None


def parse_typed(content: bytes, kind: type[T], path: Path) -> T:
    """Parse the JSON ``content`` of the file ``path`` as an object of ``kind``.

    Raises DamagedError.
    """
    return typed(parse_json(content, path), kind, path)


def typed(value: Any, kind: type[T], path: Path) -> T:
    """The JSON ``value`` of the file ``path`` as an object of ``kind``; raises DamagedError."""
    try:
        return adapter(cast(Any, kind)).validate_python(value)
    except ValidationError as error:
        raise DamagedError(path, describe_misfit(error)) from None


@cache
def adapter(kind: Any) -> TypeAdapter[Any]:
    """pydantic's reader of a type.

    Dataclasses have the configuration `STRICT`; other types get it here.
    """
    return TypeAdapter(kind) if is_dataclass(kind) else TypeAdapter(kind, config=STRICT)


def describe_misfit(error: ValidationError) -> str:
    """Describe the first fault: ``is damaged: psnr is '27' (input should be a valid number)``."""
    first: ErrorDetails = error.errors(include_url=False)[0]
    key = ".".join(str(part) for part in first["loc"])
    if first["type"] == "missing":
        return f"is damaged: it lacks {key!r}"
    message = first["msg"].removeprefix("Value error, ").partition(" or an instance")[0]
    if not key:
        return f"is damaged: {message}"
    return f"is damaged: {key} is {reprlib.repr(first['input'])} ({message.lower()})"
