"""Pictures that some program rendered: matching them with photographs by name, without guesses, and measuring them."""

import re
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from gsbench.errors import InputError
from gsbench.eval.evaluator import Evaluator
from gsbench.logs import Progress, no_progress
from gsbench.scene.images import image_size, read_image
from gsbench.scene.masks import read_mask
from gsbench.words import counted, some_of

DIGITS = re.compile(r"\d+")
SAME_NAMES = ""
BY_ORDER = "by order"


@dataclass(frozen=True)
class Matching:
    """The picture of each photograph; ``rule`` says by what names were equal ("" where they are the same), and
    ``left_out`` names the pictures that belong to none.
    """

    pairs: Mapping[str, str]
    rule: str
    left_out: tuple[str, ...]


def match_pictures(photographs: Sequence[str], pictures: Sequence[str], by_order: str = "--by-order") -> Matching:
    """Match names (relative paths) by the first rule under which every photograph has exactly one picture.

    The rules, from strict to loose: the same name; apart from the extension; with folders written as part of the name;
    apart from case; apart from a beginning and an end that all names of a folder share; apart from leading zeros; and
    the last four without the folders. Raises `InputError` where a photograph has several pictures under the strictest
    rule that finds any for all, or where no rule finds one for each; ``by_order`` is how one asks for `match_by_order`.
    """
    for rule, keys in _RULES.items():
        of_photographs, of_pictures = keys(photographs), keys(pictures)
        if len(set(of_photographs.values())) < len(photographs):
            continue  # under this rule the photographs themselves cannot be told apart
        by_key = defaultdict(list)
        for picture in pictures:
            by_key[of_pictures[picture]].append(picture)
        if not all(key in by_key for key in of_photographs.values()):
            continue
        found = {photograph: by_key[key] for photograph, key in of_photographs.items()}
        for photograph, candidates in found.items():
            if len(candidates) > 1:
                raise InputError(f"{', '.join(sorted(candidates))} all fit the photograph {photograph}: leave one")
        pairs = {photograph: candidates[0] for photograph, candidates in found.items()}
        return Matching(pairs, rule, tuple(sorted(set(pictures) - set(pairs.values()))))
    raise InputError(_no_match(photographs, pictures, by_order))


def match_by_order(photographs: Sequence[str], pictures: Sequence[str]) -> Matching:
    """The k-th picture for the k-th photograph, both sorted with numbers by value; raises `InputError` unless equally
    many."""
    if len(photographs) != len(pictures):
        raise InputError(
            f"there are {counted(len(pictures), 'picture')} for {counted(len(photographs), 'photograph')}: by order, "
            "each needs one"
        )
    in_order = sorted(photographs, key=_by_value), sorted(pictures, key=_by_value)
    pairs = dict(zip(*in_order, strict=True))
    return Matching({photograph: pairs[photograph] for photograph in photographs}, BY_ORDER, ())


def _no_match(photographs: Sequence[str], pictures: Sequence[str], by_order: str) -> str:
    missing = list(photographs)
    for keys in _RULES.values():  # the rule that came closest
        found, wanted = set(keys(pictures).values()), keys(photographs)
        missing = min(missing, [name for name in photographs if wanted[name] not in found], key=len)
    called = some_of(sorted(pictures)) or "there are none"
    hint = f"; {by_order} takes them as they are sorted" if len(pictures) == len(photographs) else ""
    return (
        f"{len(missing)} of {counted(len(photographs), 'photograph')} have no picture of their name "
        f"({some_of(missing)}); the pictures are {called}: rename them{hint}"
    )


def _stem(name: str) -> str:
    return PurePosixPath(name).with_suffix("").as_posix()


def _flat(name: str) -> str:
    return _stem(name).replace("/", "__")


def _base(name: str) -> str:
    return re.split(r"/|__", _stem(name))[-1]


def _stripped(words: Mapping[str, str]) -> dict[str, str]:
    """The words without the beginning and the end that all of them share; digits are never part of these."""
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
    return {name: DIGITS.sub(lambda digits: str(int(digits[0])), word) for name, word in words.items()}


def _by_value(name: str) -> list[tuple[int, int, str]]:
    parts = re.split(r"(\d+)", _flat(name))
    return [(1, int(part), part) if part.isdigit() else (0, 0, part) for part in parts]


Keys = Callable[[Sequence[str]], dict[str, str]]


def _each(key: Callable[[str], str]) -> Keys:
    return lambda names: {name: key(name) for name in names}


def _loosely(key: Callable[[str], str], *steps: Callable[[Mapping[str, str]], dict[str, str]]) -> Keys:
    def keys(names: Sequence[str]) -> dict[str, str]:
        words = {name: key(name).casefold() for name in names}
        for step in steps:
            words = step(words)
        return words

    return keys


_RULES: dict[str, Keys] = {
    SAME_NAMES: _each(lambda name: name),
    "apart from the extension": _each(_stem),
    "with folders as part of the name": _each(_flat),
    "apart from case": _loosely(_flat),
    "apart from what all names begin or end with": _loosely(_flat, _stripped),
    "apart from leading zeros": _loosely(_flat, _stripped, _unpadded),
    "apart from folders": _loosely(_base),
    "apart from folders and what all names begin or end with": _loosely(_base, _stripped),
    "apart from folders and leading zeros": _loosely(_base, _stripped, _unpadded),
}


@dataclass(frozen=True)
class Pair:
    """A view with the files of its photograph and of what was rendered for it, and of its mask, if it has one."""

    view: str
    photograph: Path
    picture: Path
    mask: Path | None = None


def check_sizes(pairs: Sequence[Pair]) -> None:
    """Raise `InputError` for a picture of another size than its photograph: none is ever resized."""
    for pair in pairs:
        (width, height), (wanted_width, wanted_height) = image_size(pair.picture), image_size(pair.photograph)
        if (width, height) != (wanted_width, wanted_height):
            raise InputError(
                f"{pair.picture} is {width}x{height} px, but its photograph {pair.photograph} "
                f"{wanted_width}x{wanted_height}: sizes are never changed here, so render at the photographs' size"
            )


def measure(pairs: Sequence[Pair], evaluator: Evaluator, report: Progress = no_progress) -> dict[str, dict[str, float]]:
    """The metrics of every view, in the pairs' order. Raises `InputError` for damaged files and unequal sizes."""
    check_sizes(pairs)
    per_view = {}
    for done, pair in enumerate(pairs, 1):
        mask = None if pair.mask is None else read_mask(pair.mask)
        per_view[pair.view] = evaluator.evaluate_view(read_image(pair.picture), read_image(pair.photograph), mask)
        report("views", done, len(pairs))
    return per_view
