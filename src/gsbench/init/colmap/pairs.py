"""Pairs of images to match: all, neighbours in the order of names, or proposed by a preview.

The preview matches only the strongest features of each image, after Wu, "Towards Linear-time
Incremental Structure from Motion" (3DV 2013), who skips pairs in which few of the largest features
match. Here the number of such matches ranks the partners of each image, and the best partners are
kept. Pairs of distant views are dropped with little loss, because nearer views already contain most
of their tracks.
"""

from collections.abc import Callable, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from gsbench.init.options import ColmapOptions

Pair = tuple[int, int]


def sequential_pairs(count: int, overlap: int) -> list[Pair]:
    """Pair each image with the next ``overlap`` ones and those 1, 2, 4, … after it, as in COLMAP.

    Examples:
        >>> sequential_pairs(6, 2)
        [(0, 1), (0, 2), (1, 2), (1, 3), (2, 3), (2, 4), (3, 4), (3, 5), (4, 5)]
    """
    steps = {*range(1, overlap + 1), *(2**power for power in range(overlap))}
    return sorted((i, i + step) for i in range(count) for step in steps if i + step < count)


ALL_PAIRS_UP_TO = 30  # images, 435 pairs: a preview would not pay off
STRONGEST = 256  # features of an image in the preview
# per image; gave at least 98 % of the points of all pairs on the dense captures that were tried
PARTNERS = 24
SQUARED_RATIO = 0.8**2  # of the distances to the best and the second-best match
# scale that turns descriptors of unit length into whole numbers, as in COLMAP's SIFT
QUANTUM = 512.0


def best_pairs(descriptors: Sequence[NDArray[np.generic]], partners: int = PARTNERS) -> list[Pair]:
    """Pair each image with the ``partners`` images with which it has the most matches.

    Returns sorted pairs (i, j), i < j. ``descriptors`` [K, D] belong to each image's strongest
    features, of which at most `STRONGEST` are used. They are whole numbers, or floats of unit
    length. Among equal partners, those nearer in the order of images come first.
    """
    agreement = count_agreements(descriptors)
    agreement += agreement.T
    count = len(descriptors)
    pairs: set[Pair] = set()
    for i in range(count):
        order = np.lexsort((np.abs(np.arange(count) - i), -agreement[i]))
        pairs.update((min(i, j), max(i, j)) for j in order[order != i][:partners].tolist())
    return sorted(pairs)


def proposed_pairs(
    names: Sequence[str], strongest: Callable[[str], NDArray[np.generic]]
) -> list[tuple[str, str]]:
    """The pairs of ``pairs=auto``: all for up to `ALL_PAIRS_UP_TO` images, else the `best_pairs`.

    ``strongest`` returns the descriptors of an image's strongest features.
    """
    if len(names) <= ALL_PAIRS_UP_TO:
        return list(combinations(names, 2))
    return _named(best_pairs([strongest(name) for name in names]), names)


def _named(pairs: Sequence[Pair], names: Sequence[str]) -> list[tuple[str, str]]:
    return [(names[first], names[second]) for first, second in pairs]


def count_agreements(descriptors: Sequence[NDArray[np.generic]]) -> NDArray[np.int64]:
    """Count mutual nearest neighbours that pass the ratio test, for images i < j, as [N, N].

    Descriptors are whole numbers here, and their products stay below 2^24. They are exact in
    float32, so the counts are the same on every machine and with any number of threads.
    """
    tables = []
    for part in descriptors:
        table = part[:STRONGEST].astype(np.float32)
        tables.append((QUANTUM * table).round() if part.dtype.kind == "f" else table)
    squares = [(table**2).sum(axis=1) for table in tables]
    agreements = np.zeros((len(tables), len(tables)), dtype=np.int64)
    for i, j in combinations(range(len(tables)), 2):
        distances = squares[i][:, None] + squares[j] - 2 * tables[i] @ tables[j].T  # [S, S]
        if not distances.size:
            continue
        rows, nearest = np.arange(len(distances)), distances.argmin(axis=1)
        mutual = distances.argmin(axis=0)[nearest] == rows
        best = distances[rows, nearest]
        distances[rows, nearest] = np.inf
        distinct = best < SQUARED_RATIO * distances.min(axis=1)
        agreements[i, j] = np.count_nonzero(mutual & distinct)
    return agreements


def select_pairs(names: Sequence[str], options: ColmapOptions) -> list[tuple[str, str]]:
    """The pairs of names to match; for ``auto`` all, since it drops some later."""
    if options.pairs == "sequential":
        return _named(sequential_pairs(len(names), options.overlap), names)
    return list(combinations(names, 2))
