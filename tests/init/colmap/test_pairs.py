"""Which images are paired."""

from __future__ import annotations

import itertools

from gsbench.init.colmap.pairs import exhaustive_pairs, sequential_pairs


def test_exhaustive_is_every_pair_once():
    assert exhaustive_pairs(5) == list(itertools.combinations(range(5), 2))


def test_sequential_has_near_neighbours_and_powers_of_two():
    pairs = sequential_pairs(40, 4)
    assert sorted({j - i for i, j in pairs}) == [1, 2, 3, 4, 8]
    assert len(pairs) == len(set(pairs)) == sum(40 - step for step in (1, 2, 3, 4, 8))
