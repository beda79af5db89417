"""Matching names: of photographs in models and lists, of masks, renders and poses, to files.

`match` gives each name the file that fits best. `match_pictures` is for renders, whose names follow
one rule, under which all of them fit.
"""

import re
import unicodedata
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from os.path import commonprefix
from pathlib import PurePosixPath
from typing import Any, TypeVar

from gsbench.errors import InputError
from gsbench.parsing import table_beside
from gsbench.words import counted, some_of

FILES: dict[str, Any] = table_beside(__file__, "files.yaml")
IMAGE_SUFFIXES = frozenset(FILES["photographs"])

T = TypeVar("T")
Key = Callable[[str], str]
Step = Callable[[Sequence[str]], Sequence[str]]


def stem_of(name: str) -> str:
    """The path of an image without its extension."""
    path = PurePosixPath(name)
    return (path.with_suffix("") if path.suffix.lower() in IMAGE_SUFFIXES else path).as_posix()


def parts_of(path: str) -> list[str]:
    return path.replace("\\", "/").split("/")


def plain(name: str) -> str:
    """The name as most programs write it: macOS writes é as two characters (NFD)."""
    return unicodedata.normalize("NFC", name)


def keys_of(form: Key) -> tuple[Key, ...]:
    """Keys under which names are equal as ``form`` gives them, from the strictest to the loosest.

    They are the name, the name without extension, and both without capitals.
    """
    return (
        form,
        lambda name: stem_of(form(name)),
        lambda name: form(name).casefold(),
        lambda name: stem_of(form(name)).casefold(),
    )


NAME_KEYS = keys_of(plain)


def grouped(names: Iterable[str], key_of: Callable[[str], T]) -> dict[T, list[str]]:
    """The names by their key."""
    groups: dict[T, list[str]] = defaultdict(list)
    for name in names:
        groups[key_of(name)].append(name)
    return groups


def match(
    wanted: Iterable[str], files: Iterable[str], keys: Sequence[Key] = NAME_KEYS
) -> dict[str, str]:
    """Map each wanted name to its file; names without one are left out.

    A file of the same name comes first, then the only file with the same key, for each of ``keys``.
    Better matches take their files, so that no name gets the file of another name. Raises
    `InputError` if several files fit a name, or several names a file.
    """
    names, free = list(dict.fromkeys(wanted)), set(files)
    matches = {name: name for name in names if name in free}
    for key_of in keys:
        free -= set(matches.values())
        by_key = grouped(free, key_of)
        for key, own in grouped([name for name in names if name not in matches], key_of).items():
            found = sorted(by_key.get(key, ()))
            if len(found) > 1:
                raise InputError(
                    f"{own[0]} may be {' or '.join(found)}: keep one of these files, or name one "
                    "exactly"
                )
            if found and len(own) > 1:
                raise InputError(
                    f"{found[0]} may be {' or '.join(sorted(own))}: give each image a file of its "
                    "own"
                )
            if found:
                matches[own[0]] = found[0]
    return matches


def match_anywhere(wanted: Iterable[str], files: Iterable[str]) -> dict[str, str]:
    """`match`, and if no file fits any name, by the last parts of their paths.

    As many parts are compared as give a match (``b/a.jpg`` for ``C:\\data\\b\\a.jpg``).
    """
    names, found = list(wanted), set(files)
    matches = match(names, found)
    longest = max((len(parts_of(name)) for name in names), default=0)
    for count in range(longest, 0, -1):
        if matches:
            break
        tail = keys_of(lambda name, count=count: "/".join(parts_of(plain(name))[-count:]))  # type: ignore[misc]
        matches = match(names, found, tail)
    return matches


def same_folder(one: str, other: str) -> bool:
    """Return whether two names have the same folder, up to capitals."""
    one, other = plain(one), plain(other)
    return parts_of(one)[:-1] == parts_of(other)[:-1] or one.casefold() == other.casefold()


@dataclass(frozen=True)
class Matching:
    """The picture of each photograph. ``left_out`` are the pictures without a photograph.

    ``rule`` says how the names were compared; it is "" if they are the same.
    """

    pairs: Mapping[str, str]
    rule: str
    left_out: tuple[str, ...]


def match_pictures(photographs: Sequence[str], pictures: Sequence[str]) -> Matching:
    """Match names (relative paths) by the first rule under which every photograph has a picture.

    The rules are `PICTURE_RULES`, from strict to loose. Raises `InputError` if that rule gives a
    photograph several pictures, or if no rule gives each a picture.
    """
    missing = photographs  # by the rule that leaves the fewest
    for rule, steps in PICTURE_RULES.items():
        keys = _keys(photographs, steps)
        by_key = grouped(pictures, _keys(pictures, steps).__getitem__)
        if len({*keys.values()}) < len(photographs):
            continue
        if lacking := [name for name in photographs if keys[name] not in by_key]:
            missing = min(missing, lacking, key=len)
            continue
        for photograph, key in keys.items():
            if len(by_key[key]) > 1:
                raise InputError(
                    f"{', '.join(sorted(by_key[key]))} all fit the photograph {photograph}: leave "
                    "one"
                )
        pairs = {photograph: by_key[key][0] for photograph, key in keys.items()}
        return Matching(pairs, rule, tuple(sorted(set(pictures) - set(pairs.values()))))
    called = some_of(sorted(pictures)) or "there are none"
    is_paired = len(pictures) == len(photographs)
    hint = "; --by-order takes them as they are sorted" if is_paired else ""
    raise InputError(
        f"{len(missing)} of {counted(len(photographs), 'photograph')} have no picture of their "
        f"name ({some_of(missing)}); the pictures are {called}: rename them{hint}"
    )


def match_by_order(photographs: Sequence[str], pictures: Sequence[str]) -> Matching:
    """Match the k-th picture, with numbers by value, with the k-th photograph.

    Raises `InputError` if there are not equally many, or if the photographs have another order as
    text than with numbers by value: 3DGS renders them in the order of text (1, 10, 2), other
    programs by value.
    """
    if len(photographs) != len(pictures):
        raise InputError(
            f"there are {counted(len(pictures), 'picture')} for "
            f"{counted(len(photographs), 'photograph')}: by order, "
            "each needs one"
        )
    in_order = sorted(photographs, key=_by_value)
    if in_order != sorted(photographs):
        raise InputError(
            f"by order, the photographs are {some_of(sorted(photographs))} as text and "
            f"{some_of(in_order)} by number, and programs render in either order: name the "
            "pictures after their photographs"
        )
    pairs = dict(zip(in_order, sorted(pictures, key=_by_value), strict=True))
    return Matching({photograph: pairs[photograph] for photograph in photographs}, "by order", ())


def _flat(names: Sequence[str]) -> list[str]:
    return [stem_of(name).replace("/", "__") for name in names]


def _base(names: Sequence[str]) -> list[str]:
    return [word.split("__")[-1] for word in _flat(names)]


def _folded(words: Sequence[str]) -> list[str]:
    return [word.casefold() for word in words]


def _stripped(words: Sequence[str]) -> list[str]:
    """The words without the start and the end that all of them share.

    Digits next to the rest are kept, so that numbers stay whole.
    """
    if len(words) < 2:
        return list(words)
    # Letters are compared, not parts of paths.
    start = len(commonprefix(words).rstrip("0123456789"))  # noqa: RUF071
    ends = [word[start:][::-1] for word in words]
    end = len(commonprefix(ends).rstrip("0123456789"))  # noqa: RUF071
    return [word[start : len(word) - end] for word in words]


def _unpadded(words: Sequence[str]) -> list[str]:
    return [re.sub(r"\d+", lambda digits: str(int(digits[0])), word) for word in words]


def _by_value(name: str) -> list[tuple[int, int, str]]:
    parts = re.split(r"(\d+)", _flat([name])[0])
    return [(1, int(part), part) if part.isdecimal() else (0, 0, part) for part in parts]


def _keys(names: Sequence[str], steps: Sequence[Step]) -> dict[str, str]:
    words = names
    for step in steps:
        words = step(words)
    return dict(zip(names, words, strict=True))


# From strict to loose: the steps that change names to words, which are compared.
PICTURE_RULES: Mapping[str, Sequence[Step]] = {
    "": (),
    "apart from the extension": (_flat,),  # a/b.png may be written a__b.png
    "apart from case": (_flat, _folded),
    "apart from what all names begin or end with, and leading zeros": (
        _flat,
        _folded,
        _stripped,
        _unpadded,
    ),
    "apart from folders": (_base, _folded),
    "apart from folders, what all names begin or end with, and leading zeros": (
        _base,
        _folded,
        _stripped,
        _unpadded,
    ),
}
