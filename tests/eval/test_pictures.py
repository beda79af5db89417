"""Pictures are measured without changes, in the given order, or refused."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from gsbench.eval import pictures
from gsbench.eval.evaluator import Evaluator
from gsbench.eval.pictures import PicturePair, measure
from gsbench.eval.protocol import PAPER
from tests.helpers import refusal


@pytest.fixture
def pairs(tmp_path):
    rng = np.random.default_rng(0)
    made = []
    for view in ("b", "a"):
        photograph, picture = tmp_path / f"{view}.png", tmp_path / f"{view}_render.png"
        Image.fromarray(rng.integers(0, 256, (40, 50, 3), dtype=np.uint8)).save(photograph)
        Image.fromarray(rng.integers(0, 256, (40, 50, 3), dtype=np.uint8)).save(picture)
        made.append(PicturePair(view, photograph, picture))
    return made


def test_metrics_are_computed_from_the_pixels_of_the_files(pairs):
    counts = np.zeros((40, 50), np.uint8)
    counts[5:30, :20] = 255
    mask = pairs[1].picture.with_name("mask.png")
    Image.fromarray(counts).save(mask)
    pairs[1] = replace(pairs[1], mask=mask)
    told = []
    evaluator = Evaluator(PAPER, lpips=(), flip=False)
    per_view = measure(pairs, evaluator, lambda *what: told.append(what))
    assert list(per_view) == ["b", "a"]
    assert told == [("views", 1, 2), ("views", 2, 2)]
    for pair, counted in zip(pairs, (counts == counts, counts > 0), strict=True):
        render, truth = (
            np.asarray(Image.open(path), dtype=float) for path in (pair.picture, pair.photograph)
        )
        expected = 10 * np.log10(255**2 / ((render - truth)[counted] ** 2).mean())
        # pixels are in single precision before they are squared
        assert per_view[pair.view]["psnr"] == pytest.approx(expected, abs=1e-6)


def reduced(path):
    Image.open(path).resize((25, 20)).save(path)


def truncated(path):
    path.write_bytes(path.read_bytes()[:500])


@pytest.mark.parametrize(
    "harm, index, said",
    [
        (reduced, 1, r"a_render\.png is 25x20 px, but its photograph .*a.png 50x40"),
        (truncated, 0, r"b_render\.png: the image is damaged"),
    ],
)
def test_a_picture_that_cannot_be_compared_is_named(pairs, harm, index, said):
    harm(pairs[index].picture)
    with refusal(said):
        measure(pairs, Evaluator(PAPER, lpips=(), flip=False))


def test_pictures_too_large_to_be_measured_are_refused_by_their_header(tmp_path, monkeypatch):
    Image.new("1", (100, 100)).save(tmp_path / "a.png")
    pair = pictures.PicturePair("a", tmp_path / "a.png", tmp_path / "a.png")
    pictures.check_picture_sizes([pair])
    monkeypatch.setattr(pictures, "MAX_PIXELS", 9_999)
    with refusal("100x100 px: pictures of more than"):
        pictures.check_picture_sizes([pair])
