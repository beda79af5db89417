"""Pictures are matched with photographs by name, or the error says why not."""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsbench.errors import InputError
from gsbench.scene.names import match_by_order, match_pictures
from tests.helpers import refusal
from tests.scene.tables import TABLES


@pytest.mark.parametrize("photographs, pictures, rule", TABLES["pictures matched"])
def test_names_are_matched_by_the_strictest_rule_that_fits(photographs, pictures, rule):
    found = match_pictures(photographs, random.Random(0).sample(pictures, len(pictures)))
    assert found.pairs == dict(zip(photographs, pictures, strict=True))
    assert list(found.pairs) == photographs
    assert found.rule == rule
    assert found.left_out == ()


def test_renders_of_training_views_are_left_out():
    found = match_pictures(["0000.png", "0008.png"], [f"{index:04d}.png" for index in range(10)])
    assert found.pairs == {"0000.png": "0000.png", "0008.png": "0008.png"}
    assert len(found.left_out) == 8


@pytest.mark.parametrize("photographs, pictures, words", TABLES["pictures refused"])
def test_missing_and_ambiguous_pictures_are_refused(photographs, pictures, words):
    with refusal(words):
        match_pictures(photographs, pictures)


def test_matching_by_order_sorts_numbers_by_value():
    found = match_by_order(["a01.png", "a02.png", "a10.png"], ["10.png", "0.png", "9.png"])
    assert found.pairs == {"a01.png": "0.png", "a02.png": "9.png", "a10.png": "10.png"}
    with refusal("a1.png, a10.png, a2.png as text and a1.png, a2.png, a10.png by number"):
        match_by_order(["a1.png", "a2.png", "a10.png"], ["0.png", "1.png", "2.png"])
    with refusal("2 pictures for 3 photographs"):
        match_by_order(["a", "b", "c"], ["1", "2"])
    assert match_by_order(["m1²2.png"], ["a.png"]).pairs  # ² is a digit that int() refuses


@given(
    numbers=st.sets(st.integers(0, 99_999), min_size=1, max_size=12),
    wrong=st.sets(st.integers(0, 99_999), min_size=1, max_size=12),
    prefix=st.sampled_from(["", "IMG_", "frame-", "cam/"]),
    width=st.integers(1, 6),
)
def test_matched_names_always_have_equal_numbers(numbers, wrong, prefix, width):
    photographs = [f"{prefix}{number:05d}.JPG" for number in sorted(numbers)]
    pictures = [f"{number:0{width}d}.png" for number in sorted(wrong)]
    try:
        found = match_pictures(photographs, pictures)
    except InputError:
        return
    for photograph, picture in found.pairs.items():
        assert int(photograph[len(prefix) :].split(".")[0]) == int(picture.split(".")[0])
