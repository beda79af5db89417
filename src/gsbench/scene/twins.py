"""Photographs that a capture has twice: copies, and views that look nearly the same.

If a copy of a test view is trained on, that test view measures memory. So copies of test views are
left out of training. Near twins, such as the next shot of a burst, are used and reported.
"""

from collections import Counter, defaultdict
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np
from PIL import Image

from gsbench.files import file_sha256
from gsbench.runs.trial_record import TwinViews
from gsbench.scene.beside import resize_mask
from gsbench.scene.names import grouped, stem_of
from gsbench.scene.rules import given
from gsbench.scene.types import Array, Mask, Scene, View

# Near twins are compared as grey pictures of 24 x 24 cells, whatever their sizes and shapes,
# because a copy may be shrunk, rounded or cut. In 16 captures, a second shot that is moved by half
# a percent of its width correlates by at least .983 with the first, and one that is encoded again
# by over .99. Between neighbours of ordinary captures the median is .09 to .98.
GRID = 24  # cells per side
NEAR = 0.978  # correlation
LEAST_CELLS = 64  # cells that count in both small pictures; fewer are too few to compare
LEAST_DEVIATION = 1.0  # of 255 grey values; a small picture that varies less has no content


def copies_by_name(names: Sequence[str], wanted: Collection[str] = ()) -> dict[str, str]:
    """Map each unused copy to the photograph used instead; their paths differ by the extension.

    Of such photographs, a name in ``wanted`` is used first; then the extension that more of the
    ``names`` have, so that a folder which has all photographs in one format is read in that format;
    then the first name (a.jpg before a.png).

    Examples:
        >>> copies_by_name(["a.jpg", "a.png", "b.jpg"])
        {'a.png': 'a.jpg'}
    """
    frequency = Counter(_suffix(name) for name in names)

    def rank(name: str) -> tuple[bool, int, str]:
        return name not in wanted, -frequency[_suffix(name)], name

    copies: dict[str, str] = {}
    for group in grouped(names, stem_of).values():
        used = min(group, key=rank)
        copies |= {name: used for name in group if name != used}
    return copies


def _suffix(name: str) -> str:
    return PurePosixPath(name).suffix.lower()


def copies_of_test_views(folder: Path, train: Sequence[str], test: Sequence[str]) -> dict[str, str]:
    """Map each training file in ``folder`` that equals a test file, byte by byte, to that file.

    Only files of equal size are read, so a capture without copies costs no reading.
    """

    def size(name: str) -> str:
        file = folder / name
        return str(file.stat().st_size) if file.is_file() else name  # a link to nowhere

    by_size = grouped(test, size)
    copies: dict[str, str] = {}
    for name in train:
        for other in by_size.get(size(name), ()):
            if file_sha256(folder / other) == file_sha256(folder / name):
                copies.setdefault(name, other)
    return copies


def without_copies(scene: Scene) -> Scene:
    """Leave out training views that have the pixels of a test view, and record near twins.

    Pixels are compared at their final size, where both masks count. ``twins`` of the returned scene
    holds both. Raises InputError if no training view is left.
    """
    small = {view.name: small_picture(view) for view in (*scene.train, *scene.test)}
    equal: dict[str, str] = {}
    candidates: dict[str, list[tuple[float, str]]] = defaultdict(list)
    for test in scene.test:
        for view in scene.train:
            value = likeness(small[test.name], small[view.name])
            # Comparing all pixels is costly, so only similar pictures are compared.
            if value < NEAR:  # false for NaN, so these are compared
                continue
            if same_pixels(test, view):
                equal[view.name] = test.name
            elif value >= NEAR:
                candidates[test.name].append((value, view.name))
    near: dict[str, str] = {}
    for name, found in candidates.items():
        if trained_on := [twin for twin in found if twin[1] not in equal]:
            near[name] = max(trained_on)[1]
    train = tuple(view for view in scene.train if view.name not in equal)
    given("no-training-view", len(train), f"scene {scene.name}")
    return replace(scene, train=train, twins=TwinViews(left_out=equal, near=near))


SmallPicture = tuple[Array, Mask]  # grey values and counted cells


def small_picture(view: View) -> SmallPicture:
    """The view as a small grey picture [GRID, GRID], and the cells that count."""
    size = (GRID, GRID)
    grey = Image.fromarray(view.image).convert("L").resize(size, Image.Resampling.BOX)
    counts = np.ones(size, bool) if view.mask is None else resize_mask(view.mask, *size)
    return np.asarray(grey, dtype=np.float64), counts


def likeness(one: SmallPicture, other: SmallPicture) -> float:
    """The correlation of two small pictures over the cells that count in both.

    It is NaN if there is too little to compare. A correlation ignores brightness and contrast,
    which a camera's exposure changes between two shots.
    """
    both = one[1] & other[1]
    if both.sum() < LEAST_CELLS:
        return float("nan")
    first, second = one[0][both], other[0][both]
    if min(first.std(), second.std()) < LEAST_DEVIATION:
        return float("nan")
    return float(np.corrcoef(first, second)[0, 1])


def same_pixels(one: View, other: View) -> bool:
    """Return whether views are equal where both masks count; False if no pixel counts in both."""
    if one.image.shape != other.image.shape:
        return False
    both = np.ones(one.image.shape[:2], bool)
    for mask in (one.mask, other.mask):
        if mask is not None:
            both &= mask
    return bool(both.any()) and np.array_equal(one.image[both], other.image[both])
