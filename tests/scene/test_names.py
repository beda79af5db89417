"""Pictures are matched with photographs by name, or the error says why not."""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsbench.errors import InputError
from gsbench.scene.names import match_by_order, match_pictures
from tests.helpers import refusal

PHOTOGRAPHS = ["DSC08000.JPG", "DSC08008.JPG", "DSC08016.JPG"]


@pytest.mark.parametrize(
    "photographs, pictures, rule",
    [
        (PHOTOGRAPHS, ["DSC08000.JPG", "DSC08008.JPG", "DSC08016.JPG"], ""),
        (PHOTOGRAPHS, ["DSC08000.png", "DSC08008.png", "DSC08016.png"], "apart from the extension"),
        (["a/1.png", "b/1.png"], ["a__1.png", "b__1.png"], "with folders as part of the name"),
        (PHOTOGRAPHS, ["dsc08000.PNG", "dsc08008.PNG", "dsc08016.PNG"], "apart from case"),
        (
            PHOTOGRAPHS,
            ["render_DSC08000_rgb.png", "render_DSC08008_rgb.png", "render_DSC08016_rgb.png"],
            "apart from what all names begin or end with",
        ),
        (
            ["gt_1.png", "gt_2.png"],
            ["pred_1.png", "pred_2.png"],
            "apart from what all names begin or end with",
        ),
        (["0007.png", "0012.png"], ["7.png", "12.png"], "apart from leading zeros"),
        (["v0007.png", "v0012.png"], ["r_07.jpg", "r_12.jpg"], "apart from leading zeros"),
        (
            ["cam/07.png", "cam/12.png"],
            ["07.png", "12.png"],
            "apart from what all names begin or end with",
        ),
        (["cam/x/07.png", "cam/y/12.png"], ["07.png", "12.png"], "apart from folders"),
        (
            ["cam/x/07.png", "cam/y/12.png"],
            ["r7.png", "r12.png"],
            "apart from folders and leading zeros",
        ),
    ],
)
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


@pytest.mark.parametrize(
    "photographs, pictures, words",
    [
        (
            ["a.JPG", "b.JPG"],
            ["a.png", "a.jpg", "b.png"],
            "a.jpg, a.png all fit the photograph a.JPG",
        ),
        (
            ["1.png", "2.png"],
            ["01.png", "1.png", "002.png"],
            "01.png, 1.png all fit the photograph 1.png",
        ),
        (
            ["10.png", "11.png"],
            ["20.png", "21.png"],
            "2 of 2 photographs have no picture .*--by-order",
        ),
        (["10.png", "11.png"], ["0.png", "1.png"], "--by-order"),
        (PHOTOGRAPHS, ["DSC08000.png", "DSC08008.png"], r"1 of 3 photographs .*\(DSC08016.JPG\)"),
        (PHOTOGRAPHS, [], "3 of 3 photographs .*there are none"),
        (["view7.png"], ["other.png"], "1 of 1 photograph have no picture"),
    ],
)
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
