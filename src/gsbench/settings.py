"""Checking settings, which are dataclasses whose annotations say what is allowed.

The annotation of a field is its rule: a type, bounds (`annotated_types`, or pydantic's types such
as ``PositiveInt``), or a ``Literal`` of choices. pydantic checks it, and `describe` puts it into
words. Numbers must be finite, except a default of the class. Rules between fields belong in the
``__post_init__`` of their class.
"""

import dataclasses
import inspect
import re
import reprlib
import sys
import types
from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from annotated_types import DocInfo, GroupedMetadata, Interval, Predicate, doc
from pydantic import ConfigDict, PydanticUserError, TypeAdapter, ValidationError

from gsbench.errors import InputError
from gsbench.words import did_you_mean, is_path

PathName = Annotated[str, Predicate(is_path), doc("a path")]
AnyPath = Annotated[str | Path, Predicate(lambda path: is_path(str(path))), doc("a path")]
MAX_INTEGER = 2**63 - 1  # the largest whole number of torch and NumPy
MAX_NAME_BYTES = 100  # of a name: a folder's name can combine two, and file systems allow 255
ARM_BYTES = 2 * MAX_NAME_BYTES + 1  # of the folder INIT-DENSIFY


def is_folder_name(value: str, most: int = MAX_NAME_BYTES) -> bool:
    """Return whether a text of at most ``most`` bytes can name a folder on any system.

    It must also fit the address of a trial (``x:scene:arm:0``), be no option of a command, and no
    formula for a spreadsheet.
    """
    is_plain = value.isprintable() and not set(value) & set('/\\:*?"<>|') and value == value.strip()
    return is_plain and value[:1] not in ("", *".-=+@") and len(value.encode()) <= most


def is_address(value: str) -> bool:
    """Return whether a text can be the address of a tracker."""
    return re.fullmatch(r"[a-z][a-z0-9+.-]*://\S*", value) is not None and value.isprintable()


FOLDER_RULE = f"a plain folder name of at most {MAX_NAME_BYTES} bytes"
FolderName = Annotated[str, Predicate(is_folder_name), doc(FOLDER_RULE)]
Address = Annotated[str, Predicate(is_address), doc("an address such as http://HOST:PORT")]
TargetName = Annotated[
    str,
    Predicate(lambda name: "." in name and all(part.isidentifier() for part in name.split("."))),
    doc("the import path of a class, such as mine.MyClass"),
]
MISSING: Any = "???"  # a value that must be given, as Hydra writes it in YAML
Fraction = Annotated[float, Interval(ge=0, le=1)]
# a larger number is a mistake, and no system could start them
Threads = Annotated[int, Interval(ge=1, le=4096)]
OpenFraction = Annotated[float, Interval(gt=0, lt=1)]


@dataclasses.dataclass(frozen=True)
class Switch:
    """A part of a method that ``gsbench ablate`` can switch off."""

    off: dict[str, Any]  # the settings that switch it off
    words: str = ""  # what it is
    within: str = ""  # a switch without which this one has no effect


CONFIG = ConfigDict(allow_inf_nan=False, arbitrary_types_allowed=True, coerce_numbers_to_str=True)
PLAIN = {
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    str: "a text",
    dict: "a mapping {key: value}",
}


def check_settings(settings: Any, group: str) -> None:
    """Check every field of ``settings`` by its annotation, and convert it (``1e3`` to 1000).

    ``settings`` is an object of a dataclass. Raises InputError that names ``group`` and the field,
    the allowed values, and the given value.
    """
    given = {field.name: getattr(settings, field.name) for field in option_fields(type(settings))}
    for name, value in check_values(type(settings), given, group).items():
        object.__setattr__(settings, name, value)  # the dataclass may be frozen


def check_values(cls: type, values: Mapping[str, Any], group: str) -> dict[str, Any]:
    """Convert ``values``, options of the dataclass ``cls``, to the types of its annotations.

    Raises InputError for the first unknown or forbidden option. Its message starts with the name of
    ``group`` and a dot, or with the option for the root group ``""``.
    """
    prefix = f"{group}." if group else ""
    known = {field.name: field for field in option_fields(cls)}
    result = {}
    for name, value in values.items():
        if name not in known:
            raise InputError(unknown_setting(f"{prefix}{name}", name, known))
        result[name] = _converted(value, known[name], cls, f"{prefix}{name}")
    return result


def unknown_setting(key: str, name: str, known: Collection[str]) -> str:
    """The message for a ``key`` whose last part ``name`` is not among the ``known`` settings."""
    existing = f"there are: {', '.join(known)}" if known else "there are no settings"
    return f"{key} is not a setting{did_you_mean(name, known)} ({existing})"


def option_fields(cls: type) -> list[dataclasses.Field[Any]]:
    """The fields of a dataclass that are arguments of its constructor."""
    return [field for field in dataclasses.fields(cls) if field.init]


def describe(hint: Any) -> str:
    """An annotation in words that fit after "must be".

    Examples:
        >>> from annotated_types import Gt
        >>> describe(Annotated[int, Gt(0)] | None)
        'a whole number above 0 or null'
        >>> describe(Literal["soft", "hard", "curve"])
        "'soft', 'hard' or 'curve'"
    """
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _describe_annotated(arguments[0], list(_flatten(arguments[1:])))
    if origin is Literal:
        return _one_of([repr(choice) for choice in arguments])
    if origin in (Union, types.UnionType):
        return _one_of(
            ["null" if choice is type(None) else describe(choice) for choice in arguments]
        )
    if origin is list:
        return f"a list, each {describe(arguments[0])}"
    if origin is tuple:
        return f"a list of {len(arguments)}, each {describe(arguments[0])}"
    plain = origin or hint
    return PLAIN.get(plain, f"of type {getattr(plain, '__name__', plain)}")


def _converted(value: Any, field: dataclasses.Field[Any], cls: type, key: str) -> Any:
    hint, adapter = _adapters(cls)[field.name]
    try:
        result = adapter.validate_python(value)
        too_large = _has_too_large(result)
        if not too_large and not _has_switch_for_number(value, result):
            return result
        reason = (
            f": whole numbers lie between -{MAX_INTEGER} and {MAX_INTEGER}" if too_large else ""
        )
    except ValidationError as error:
        if value is field.default or (isinstance(value, float) and value == field.default):
            return value  # a class's own default is allowed even if its annotation forbids it
        first = error.errors()[0]
        reason = (
            f": {first['ctx']['error']}"
            if first["type"] in ("value_error", "assertion_error")
            else ""
        )
    raise InputError(f"{key} must be {describe(hint)}, got {_shown(value)}{reason}")


def _has_too_large(value: Any) -> bool:
    """Return whether a value has a whole number of more than 64 bits, too large for torch."""
    if isinstance(value, Mapping):
        return any(map(_has_too_large, value.values()))
    if isinstance(value, list | tuple):
        return any(map(_has_too_large, value))
    return isinstance(value, int) and abs(value) > MAX_INTEGER


def _has_switch_for_number(given: Any, result: Any) -> bool:
    """Return whether a ``true`` or ``false`` became a number, which pydantic allows."""
    if isinstance(given, Sequence) and not isinstance(given, str):
        return any(map(_has_switch_for_number, given, result))
    return isinstance(given, bool) and not isinstance(result, bool)


@cache
def _adapters(cls: type) -> dict[str, tuple[Any, TypeAdapter[Any]]]:
    result = {}
    for field in option_fields(cls):
        hint = _hint(cls, field.name)
        try:
            result[field.name] = hint, TypeAdapter(hint, config=CONFIG)
        except PydanticUserError:  # a type with its own configuration, such as a nested dataclass
            result[field.name] = hint, TypeAdapter(hint)
    return result


def _hint(cls: type, name: str) -> Any:
    """The annotation of a field with its constraints.

    It is Any if the annotation uses a name that only type checkers import.
    """
    owner = next(base for base in cls.__mro__ if name in inspect.get_annotations(base))
    # One field at a time, from the class that wrote it: `get_type_hints` of a class fails as a
    # whole if one of its names is imported for type checkers alone.
    holder = types.SimpleNamespace(__annotations__={name: inspect.get_annotations(owner)[name]})
    scope = vars(sys.modules[owner.__module__]) if owner.__module__ in sys.modules else {}
    try:
        return get_type_hints(holder, globalns=scope, include_extras=True)[name]
    except NameError:
        return Any


def _describe_annotated(base: Any, rules: list[Any]) -> str:
    documentation = next((rule.documentation for rule in rules if isinstance(rule, DocInfo)), None)
    if documentation is not None:
        return str(documentation)
    bounds = {
        bound: getattr(rule, bound)
        for rule in rules
        for bound in ("gt", "ge", "lt", "le")
        if hasattr(rule, bound)
    }
    low, high = bounds.get("gt", bounds.get("ge")), bounds.get("lt", bounds.get("le"))
    words = describe(base)
    if low is not None and high is not None:
        return (
            f"{words} in {'(' if 'gt' in bounds else '['}{low}, "
            f"{high}{')' if 'lt' in bounds else ']'}"
        )
    if low is not None:
        return f"{words} {'above' if 'gt' in bounds else 'of at least'} {low}"
    if high is not None:
        return f"{words} {'below' if 'lt' in bounds else 'of at most'} {high}"
    return words


def _flatten(metadata: Iterable[Any]) -> Iterable[Any]:
    for rule in metadata:
        yield from rule if isinstance(rule, GroupedMetadata) else getattr(rule, "metadata", [rule])


def _one_of(words: list[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} or {words[-1]}"


def _shown(value: Any) -> str:
    return (
        "null"
        if value is None
        else str(value).lower()
        if isinstance(value, bool)
        else reprlib.repr(value)
    )
