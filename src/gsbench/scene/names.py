"""Matching names: of photographs in models and lists, of masks, renders and poses, to files."""

import unicodedata
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import PurePosixPath

from gsbench.errors import InputError

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp"})

Key = Callable[[str], str]


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
        by_key: dict[str, list[str]] = defaultdict(list)
        for file in free:
            by_key[key_of(file)].append(file)
        names_by_key: dict[str, list[str]] = defaultdict(list)
        for name in names:
            if name not in matches and key_of(name) in by_key:
                names_by_key[key_of(name)].append(name)
        for key, own in names_by_key.items():
            found = sorted(by_key[key])
            if len(found) > 1:
                raise InputError(
                    f"{own[0]} may be {' or '.join(found)}: keep one of these files, or name one "
                    "exactly"
                )
            if len(own) > 1:
                raise InputError(
                    f"{found[0]} may be {' or '.join(sorted(own))}: give each image a file of its "
                    "own"
                )
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
