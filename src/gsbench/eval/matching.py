"""Matching rendered pictures with photographs by name, without guesses."""

import re
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

from gsbench.errors import InputError
from gsbench.words import counted, some_of

DIGITS = re.compile(r"\d+")
SAME_NAMES = ""
BY_ORDER = "by order"


@dataclass(frozen=True)
class Matching:
    """The picture of each photograph. ``left_out`` are the pictures without a photograph.

    ``rule`` says how the names were compared; it is "" if they are the same.
    """

    pairs: Mapping[str, str]
    rule: str
    left_out: tuple[str, ...]


def match_pictures(
    photographs: Sequence[str], pictures: Sequence[str], by_order: str = "--by-order"
) -> Matching:
    """Match names (relative paths) by the first rule under which every photograph has a picture.

    The rules, from strict to loose, compare names: as they are; without the extension; with folders
    written as part of the name; without case; without a start and an end that all names share;
    without leading zeros; and by the last three rules without folders. Raises `InputError` if that
    rule gives a photograph several pictures, or if no rule gives each a picture. ``by_order`` is
    the option that error messages suggest for `match_by_order`.
    """
    for rule, make_keys in _RULES.items():
        photograph_keys, picture_keys = make_keys(photographs), make_keys(pictures)
        if len(set(photograph_keys.values())) < len(photographs):
            continue  # this rule gives two photographs the same key
        by_key = defaultdict(list)
        for picture in pictures:
            by_key[picture_keys[picture]].append(picture)
        if not all(key in by_key for key in photograph_keys.values()):
            continue
        matches = {photograph: by_key[key] for photograph, key in photograph_keys.items()}
        for photograph, candidates in matches.items():
            if len(candidates) > 1:
                raise InputError(
                    f"{', '.join(sorted(candidates))} all fit the photograph {photograph}: leave "
                    "one"
                )
        pairs = {photograph: candidates[0] for photograph, candidates in matches.items()}
        return Matching(pairs, rule, tuple(sorted(set(pictures) - set(pairs.values()))))
    raise InputError(_no_match(photographs, pictures, by_order))


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
    return Matching({photograph: pairs[photograph] for photograph in photographs}, BY_ORDER, ())


def _no_match(photographs: Sequence[str], pictures: Sequence[str], by_order: str) -> str:
    missing = list(photographs)
    # report the rule that left the fewest photographs without a picture
    for make_keys in _RULES.values():
        picture_keys, photograph_keys = set(make_keys(pictures).values()), make_keys(photographs)
        missing = min(
            missing,
            [name for name in photographs if photograph_keys[name] not in picture_keys],
            key=len,
        )
    called = some_of(sorted(pictures)) or "there are none"
    hint = (
        f"; {by_order} takes them as they are sorted" if len(pictures) == len(photographs) else ""
    )
    return (
        f"{len(missing)} of {counted(len(photographs), 'photograph')} have no picture of their "
        f"name ({some_of(missing)}); the pictures are {called}: rename them{hint}"
    )


def _stem(name: str) -> str:
    return PurePosixPath(name).with_suffix("").as_posix()


def _flat(name: str) -> str:
    return _stem(name).replace("/", "__")


def _base(name: str) -> str:
    return re.split(r"/|__", _stem(name))[-1]


def _folded(words: Mapping[str, str]) -> dict[str, str]:
    return {name: word.casefold() for name, word in words.items()}


def _stripped(words: Mapping[str, str]) -> dict[str, str]:
    """The words without the start and the end that all of them share.

    Digits next to the rest are kept, so that numbers stay whole.
    """
    if len(words) < 2:
        return dict(words)
    texts = list(words.values())
    start = len(_common_start(texts).rstrip("0123456789"))
    end = len(_common_start([text[start:][::-1] for text in texts]).rstrip("0123456789"))
    return {name: text[start : len(text) - end] for name, text in words.items()}


def _common_start(texts: Sequence[str]) -> str:
    first, last = min(texts), max(texts)
    different = (index for index, letter in enumerate(first) if last[index : index + 1] != letter)
    return first[: next(different, len(first))]


def _unpadded(words: Mapping[str, str]) -> dict[str, str]:
    return {
        name: DIGITS.sub(lambda digits: str(int(digits[0])), word) for name, word in words.items()
    }


def _by_value(name: str) -> list[tuple[int, int, str]]:
    parts = re.split(r"(\d+)", _flat(name))
    return [(1, int(part), part) if part.isdigit() else (0, 0, part) for part in parts]


# names are equal under a rule if their keys are
KeyFunction = Callable[[Sequence[str]], dict[str, str]]


def _names(
    key: Callable[[str], str], *steps: Callable[[Mapping[str, str]], dict[str, str]]
) -> KeyFunction:
    def keys(names: Sequence[str]) -> dict[str, str]:
        words = {name: key(name) for name in names}
        for step in steps:
            words = step(words)
        return words

    return keys


_RULES: dict[str, KeyFunction] = {
    SAME_NAMES: _names(str),
    "apart from the extension": _names(_stem),
    "with folders as part of the name": _names(_flat),
    "apart from case": _names(_flat, _folded),
    "apart from what all names begin or end with": _names(_flat, _folded, _stripped),
    "apart from leading zeros": _names(_flat, _folded, _stripped, _unpadded),
    "apart from folders": _names(_base, _folded),
    "apart from folders and what all names begin or end with": _names(_base, _folded, _stripped),
    "apart from folders and leading zeros": _names(_base, _folded, _stripped, _unpadded),
}
