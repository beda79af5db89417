"""Pairs of neighbours, and pairs from a preview against a slow version in whole numbers."""

import itertools

import numpy as np
import pytest

from gsbench.init.colmap.pairs import (
    STRONGEST,
    best_pairs,
    count_agreements,
    proposed_pairs,
    sequential_pairs,
)


def slow_count(first, second):
    """Mutual nearest neighbours with a ratio test, in int64."""
    distance = ((first[:, None].astype(np.int64) - second[None].astype(np.int64)) ** 2).sum(axis=2)
    found = 0
    for i, row in enumerate(distance):
        j = int(row.argmin())
        ranked = np.sort(row)
        second_best = ranked[1] if len(ranked) > 1 else np.inf
        found += bool(distance[:, j].argmin() == i and ranked[0] < 0.64 * second_best)
    return found


def sets_of_descriptors(sizes):
    """Images that share some descriptors, with a little noise."""
    rng = np.random.default_rng(0)
    base = rng.integers(0, 256, (400, 128))
    parts = [
        base[rng.permutation(400)[:size]] + rng.integers(-20, 20, (size, 128)) for size in sizes
    ]
    return [part.clip(0, 255).astype(np.uint8) for part in parts]


def test_counts_of_agreements_are_exact():
    images = sets_of_descriptors([300, 256, 90, 1, 0])
    counts = count_agreements(images)
    for i, j in itertools.combinations(range(5), 2):
        first, second = images[i][:STRONGEST], images[j][:STRONGEST]
        assert counts[i, j] == (slow_count(first, second) if len(first) and len(second) else 0)
    assert counts[0, 1] > 20
    assert not np.tril(counts).any()


def test_float_descriptors_of_networks_are_counted_too():
    base = np.random.default_rng(1).normal(size=(50, 64)).astype(np.float32)
    base /= np.linalg.norm(base, axis=1, keepdims=True)
    assert count_agreements([base, base[::-1].copy()])[0, 1] == 50


def test_each_image_keeps_its_best_partners():
    # images on a line: the nearer two images, the more descriptors they share
    world = np.random.default_rng(2).integers(0, 256, (600, 128)).astype(np.uint8)
    images = [world[20 * i : 20 * i + 200] for i in range(12)]
    pairs = best_pairs(images, partners=2)
    expected = {(i, i + 1) for i in range(11)} | {(0, 2), (9, 11)}
    assert set(pairs) == expected
    assert pairs == sorted(pairs)
    assert best_pairs(images, partners=99) == list(itertools.combinations(range(12), 2))
    # few images get all pairs, without a preview
    assert proposed_pairs("abc", None) == [("a", "b"), ("a", "c"), ("b", "c")]


@pytest.mark.parametrize("partners", [1, 3])
def test_images_without_any_feature_still_get_partners(partners):
    pairs = best_pairs([np.zeros((0, 128), np.uint8)] * 6, partners)
    assert {image for pair in pairs for image in pair} == set(range(6))


def test_sequential_pairs_are_near_neighbours_and_powers_of_two():
    pairs = sequential_pairs(40, 4)
    assert sorted({j - i for i, j in pairs}) == [1, 2, 3, 4, 8]
    assert len(pairs) == len(set(pairs)) == sum(40 - step for step in (1, 2, 3, 4, 8))
