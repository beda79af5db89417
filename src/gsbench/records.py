"""Reading and writing JSON files through dataclasses whose annotations say what is allowed.

A file is written and read through the same type. Numbers are finite, and types are strict (no ``"27"`` and no ``true``
for a number). Unknown keys are ignored.
"""

import logging
import reprlib
from collections.abc import Iterator
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar

from annotated_types import MinLen
from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from gsbench.parsing import DamagedError, read_bytes

log = logging.getLogger(__name__)

T = TypeVar("T")

MAX_NUMBER = 1e30  # of a measured value: means and variances of such numbers do not overflow

Number = Annotated[float, Field(ge=-MAX_NUMBER, le=MAX_NUMBER)]
Amount = Annotated[float, Field(ge=0, le=MAX_NUMBER)]
Count = Annotated[int, Field(ge=0, lt=2**63)]
Whole = Annotated[int, Field(gt=-(2**63), lt=2**63)]
Text = Annotated[str, MinLen(1)]
STRICT = ConfigDict(strict=True, allow_inf_nan=False, extra="ignore")


@dataclass(frozen=True, kw_only=True)
class Record:
    """Base of records: strict types and finite numbers; unknown keys are ignored."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def to_json(self) -> dict[str, Any]:
        """The JSON object of the file, without optional keys that have their default value."""
        kind: Any = type(self)
        values: dict[str, Any] = adapter(kind).dump_python(self, mode="json")
        return {field.name: values[field.name] for field in fields(self) if not _is_default(self, field)}


def _is_default(record: Record, field: Any) -> bool:
    default = field.default if field.default_factory is MISSING else field.default_factory()
    return default is not MISSING and getattr(record, field.name) == default


def read_typed(path: Path, kind: type[T]) -> T:
    """The JSON file as an object of ``kind``; raises as `read_bytes` does, and DamagedError naming the first misfit."""
    return parse_typed(read_bytes(path), kind, path)


def read_if_sound(path: Path, kind: type[T]) -> T | None:
    """The JSON file as an object of ``kind``, or None if it is missing or damaged."""
    try:
        return read_typed(path, kind)
    except (FileNotFoundError, DamagedError):
        return None


def parse_typed(content: bytes, kind: type[T], path: Path) -> T:
    """Parse the JSON ``content`` of the file ``path`` as an object of ``kind``; raises DamagedError for a misfit.

    The parser refuses more than 200 levels and integers of more than 4,300 digits.
    """
    try:
        reader: Any = kind
        result: T = adapter(reader).validate_json(content)
        return result
    except ValidationError as error:
        raise DamagedError(path, describe_misfit(error)) from None


@cache
def adapter(kind: Any) -> TypeAdapter[Any]:
    """pydantic's reader of a type. Dataclasses have the configuration `STRICT`; other types get it here."""
    return TypeAdapter(kind) if is_dataclass(kind) else TypeAdapter(kind, config=STRICT)


def describe_misfit(error: ValidationError) -> str:
    """Describe the first fault: ``is damaged: metrics.psnr is '27' (input should be a valid number)``."""
    first: ErrorDetails = error.errors(include_url=False)[0]
    key, kind = ".".join(str(part) for part in first["loc"]), first["type"]
    if kind == "json_invalid":
        return f"is not JSON ({first['msg'].removeprefix('Invalid JSON: ')})"
    if kind in ("missing", "missing_argument"):
        return f"is damaged: it lacks {key!r}"
    if not key:
        return f"is damaged: {first['msg'].removeprefix('Value error, ')}"
    return f"is damaged: {key} is {reprlib.repr(first['input'])} ({first['msg'].removeprefix('Value error, ').lower()})"


def iterate_rows(content: bytes, kind: type[T], path: Path) -> Iterator[tuple[str, T]]:
    """Parse the JSON lines of the file ``path``; yields each line with its object of ``kind``.

    A damaged line and the lines after it are left out. There is a warning, except for an incomplete last line, which a
    killed process leaves.
    """
    lines = content.splitlines(keepends=True)
    # Parsing all lines at once is faster. Only if that fails are they parsed one by one.
    try:
        rows = parse_typed(b"[" + b",".join(lines) + b"]", list[kind], path)  # type: ignore[valid-type]
    except DamagedError:
        rows = []
    if len(rows) == len(lines):  # otherwise a line holds several values
        yield from ((line.decode("utf-8").rstrip("\r\n"), row) for line, row in zip(lines, rows, strict=True))
        return
    for number, line in enumerate(lines, 1):
        try:
            row = parse_typed(line, kind, path)
        except DamagedError as error:
            if line.endswith(b"\n") or number < len(lines):
                log.warning("left out: %s from line %d on, which %s", path, number, error.reason)
            return
        yield line.decode("utf-8").rstrip("\r\n"), row
