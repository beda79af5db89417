"""Types of the files that gsbench writes: dataclasses whose annotations say what may stand there, read from JSON.

A file is written through the same type that reads it. Numbers are finite and of their own kind (no ``"27"``, no
``true`` for 1); keys that a type does not know may stand beside its own.
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

MOST = 1e30  # of a measured number: no mean or variance of such overflows, and no measure comes near

Number = Annotated[float, Field(ge=-MOST, le=MOST)]
Amount = Annotated[float, Field(ge=0, le=MOST)]
Count = Annotated[int, Field(ge=0, lt=2**63)]
Whole = Annotated[int, Field(gt=-(2**63), lt=2**63)]
Text = Annotated[str, MinLen(1)]
STRICT = ConfigDict(strict=True, allow_inf_nan=False, extra="ignore")


@dataclass(frozen=True, kw_only=True)
class Record:
    """Base of the records: strict types, finite numbers; further keys may stand beside the known ones."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    def to_json(self) -> dict[str, Any]:
        """The object of the file; an optional key that says nothing is left out."""
        kind: Any = type(self)
        whole: dict[str, Any] = adapter(kind).dump_python(self, mode="json")
        return {entry.name: whole[entry.name] for entry in fields(self) if not _says_nothing(self, entry)}


def _says_nothing(record: Record, entry: Any) -> bool:
    default = entry.default if entry.default_factory is MISSING else entry.default_factory()
    return default is not MISSING and getattr(record, entry.name) == default


def read_typed(path: Path, kind: type[T]) -> T:
    """The JSON file as an object of ``kind``; raises as `read_bytes` does, and DamagedError naming the first misfit."""
    return typed(read_bytes(path), kind, path)


def read_if_sound(path: Path, kind: type[T]) -> T | None:
    """The JSON file as an object of ``kind``; None where it is absent or damaged."""
    try:
        return read_typed(path, kind)
    except (FileNotFoundError, DamagedError):
        return None


def typed(content: bytes, kind: type[T], path: Path) -> T:
    """JSON as an object of the type ``kind``, of the file ``path``; raises DamagedError naming the first misfit.

    More than 200 levels and integers of more than 4,300 digits are refused by the parser.
    """
    try:
        reader: Any = kind
        result: T = adapter(reader).validate_json(content)
        return result
    except ValidationError as error:
        raise DamagedError(path, misfit(error)) from None


@cache
def adapter(kind: Any) -> TypeAdapter[Any]:
    """pydantic's reader of a type: a dataclass, which brings `STRICT`, or one that is put together and given it."""
    return TypeAdapter(kind) if is_dataclass(kind) else TypeAdapter(kind, config=STRICT)


def misfit(error: ValidationError) -> str:
    """Describe the fault of a file: ``is damaged: metrics.psnr is '27' (input should be a valid number)``."""
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
    """The lines of JSON-lines, of the file ``path``, each with what it says as an object of ``kind``.

    What follows a damaged line is left out, with a warning unless it is the torn last one of a killed writer.
    """
    lines = content.splitlines(keepends=True)
    try:
        rows = typed(b"[" + b",".join(lines) + b"]", list[kind], path)  # type: ignore[valid-type] # at once, mostly
    except DamagedError:
        rows = []
    if len(rows) == len(lines):  # else a line holds several
        yield from ((line.decode("utf-8").rstrip("\r\n"), row) for line, row in zip(lines, rows, strict=True))
        return
    for number, line in enumerate(lines, 1):
        try:
            row = typed(line, kind, path)
        except DamagedError as error:
            if line.endswith(b"\n") or number < len(lines):
                log.warning("left out: %s from line %d on, which %s", path, number, error.reason)
            return
        yield line.decode("utf-8").rstrip("\r\n"), row
