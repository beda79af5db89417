"""Names of images: finding their files, selecting the images to keep, and splitting them by name."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath

from gsbench.errors import InputError
from gsbench.scene.images import IMAGE_SUFFIXES
from gsbench.scene.options import TEST_EVERY
from gsbench.words import some_of

MAX_IMAGES = 200  # the paper's limit per scene
MIN_IMAGES = 3
# Of a picture's file name. File systems allow 255, but the temporary name of a file that is being written is longer.
MAX_NAME_BYTES = 220


def match_names(wanted: Iterable[str], files: Iterable[str]) -> dict[str, str]:
    """Map each wanted image name to its file; names without a file are left out.

    A file of the same name comes first, then the only file whose path differs in the extension alone (``a.png`` for
    ``a.JPG``). There is no match if several such files fit a name, or if several names fit such a file.
    """
    files = set(files)
    by_stem: dict[str, list[str]] = defaultdict(list)
    for file in files:
        by_stem[stem_of(file)].append(file)
    matches: dict[str, str] = {}
    claims: dict[str, list[str]] = defaultdict(list)
    for name in wanted:
        if name in files:
            matches[name] = name
        elif len(by_stem[stem_of(name)]) == 1:
            claims[by_stem[stem_of(name)][0]].append(name)
    exact = set(matches.values())
    matches.update({names[0]: file for file, names in claims.items() if len(names) == 1 and file not in exact})
    return matches


def select_images(names: Sequence[str], max_images: int, least: int = MIN_IMAGES) -> list[str]:
    """Select at most ``max_images`` of n names, evenly spaced: the k-th of m selected names has index ``k * n // m``.

    The first name is always kept, and views on a closed ring stay evenly spaced. Images are selected before the split.

    Examples:
        >>> select_images(["a", "b", "c", "d", "e"], 3)
        ['a', 'b', 'd']
    """
    if max_images < least:
        raise InputError(f"scene.max_images must be at least {least}, got {max_images}")
    if len(names) <= max_images:
        return list(names)
    return [names[k * len(names) // max_images] for k in range(max_images)]


def split_names(
    names: Sequence[str],
    test_every: int = TEST_EVERY,
    train: Sequence[str] | None = None,
    test: Sequence[str] | None = None,
) -> tuple[list[str], list[str]]:
    """Split sorted names into (training, test).

    Every ``test_every``-th name from the first is a test view; ``test_every=0`` holds out none. Explicit lists replace
    this rule. If only one list is given, the other side gets all other names. If both are given, names in neither list
    are dropped.

    Raises `InputError` if there is no training view, or no test view although ``test_every`` is not 0.
    """
    if test_every < 0:
        raise InputError(f"scene.test_every must be 0 (no test views) or positive, got {test_every}")
    if train is None and test is None:
        held_out = set(names[::test_every]) if test_every else set()
    elif test is None:
        held_out = set(names) - set(train or ())
    else:
        held_out = set(test)
        if both := sorted(held_out & set(train or ())):
            raise InputError(f"the split lists hold {some_of(both)} for training and for testing: name each image once")
    kept = set(names if train is None else train)
    training = [name for name in names if name in kept and name not in held_out]
    testing = [name for name in names if name in held_out]
    if not training:
        raise InputError(
            f"the split leaves no training view of {len(names)}: raise scene.test_every or correct the lists"
        )
    if not testing and test_every:
        raise InputError(
            f"the split leaves no test view of {len(names)}: correct the lists, or give scene.test_every=0"
        )
    return training, testing


def stem_of(name: str) -> str:
    """The path of an image without its extension."""
    path = PurePosixPath(name)
    return (path.with_suffix("") if path.suffix.lower() in IMAGE_SUFFIXES else path).as_posix()


def check_picture_names(names: Iterable[str], folder: Path) -> None:
    """Raise `InputError` if a view's picture would have a too long name, or the same name as another view's."""
    view_of: dict[str, str] = {}
    for name in names:
        picture = png_name(name)
        if len(picture.encode()) > MAX_NAME_BYTES:
            raise InputError(
                f"{folder / name}: a name of more than {MAX_NAME_BYTES} bytes, folders included: shorten it"
            )
        if picture in view_of:
            raise InputError(
                f"{folder}: the pictures of {view_of[picture]} and {name} would both be {picture}: rename one"
            )
        view_of[picture] = name


def png_name(view_name: str) -> str:
    """The file name of a view's picture; sub-folders become part of the name."""
    return Path(view_name).with_suffix(".png").as_posix().replace("/", "__")
