"""Names of images: the files that they mean, and the choice of images to keep and to hold out."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath

from gsbench.errors import InputError
from gsbench.scene.images import IMAGE_SUFFIXES
from gsbench.scene.options import TEST_EVERY
from gsbench.words import some_of

MAX_IMAGES = 200  # the paper's limit per scene
MIN_IMAGES = 3
MAX_NAME_BYTES = 220  # of a picture's name; file systems end at 255, and a file that is being written has a longer one


def match_names(wanted: Iterable[str], files: Iterable[str]) -> dict[str, str]:
    """Find the file that each wanted image name means, for those that have one.

    The same name wins; else the one file with the same path but for its extension (``images_4/a.png`` for ``a.JPG``). A
    name that several files fit, or a file that several names claim, stays without a match.
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
    taken = set(matches.values())
    matches.update({names[0]: file for file, names in claims.items() if len(names) == 1 and file not in taken})
    return matches


def select_images(names: Sequence[str], max_images: int, least: int = MIN_IMAGES) -> list[str]:
    """Select at most ``max_images`` of the names, evenly spaced: the k-th of m is the one at index ``k * n // m``.

    The first is always kept, and a closed ring of views stays evenly spaced. This comes before the split.

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

    Every ``test_every``-th name from the first is a test view; ``test_every=0`` holds out none. Explicit lists win:
    with one of them the other is the rest; with both, names in neither are left out.

    Raises `InputError` if no training view is left, or no test view although ``test_every`` is not 0.
    """
    if test_every < 0:
        raise InputError(f"scene.test_every must be 0 (no test views) or positive, got {test_every}")
    if train is None and test is None:
        chosen = set(names[::test_every]) if test_every else set()
    elif test is None:
        chosen = set(names) - set(train or ())
    else:
        chosen = set(test)
        if both := sorted(chosen & set(train or ())):
            raise InputError(f"the split lists hold {some_of(both)} for training and for testing: name each image once")
    wanted = set(names if train is None else train)
    training = [name for name in names if name in wanted and name not in chosen]
    testing = [name for name in names if name in chosen]
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
    """Raise `InputError` where the pictures of two views would have one name, or a name that no file can have."""
    taken: dict[str, str] = {}
    for name in names:
        picture = png_name(name)
        if len(picture.encode()) > MAX_NAME_BYTES:
            raise InputError(
                f"{folder / name}: a name of more than {MAX_NAME_BYTES} bytes, folders included: shorten it"
            )
        if picture in taken:
            raise InputError(
                f"{folder}: the pictures of {taken[picture]} and {name} would both be {picture}: rename one"
            )
        taken[picture] = name


def png_name(view_name: str) -> str:
    """File name for the picture of a view; sub-folders become part of the name."""
    return Path(view_name).with_suffix(".png").as_posix().replace("/", "__")
