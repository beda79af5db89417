"""Pictures are measured without changes, in the given order, or refused."""

import re
import struct
import zlib
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from gsbench.eval import pictures
from gsbench.eval.evaluator import Evaluator
from gsbench.eval.pictures import PicturePair, check_pairs, measure, read_picture
from gsbench.eval.protocol import PAPER
from tests.helpers import refusal


@pytest.fixture
def pairs(tmp_path):
    rng = np.random.default_rng(0)
    made = []
    for view in ("b", "a"):
        files = tmp_path / f"{view}.png", tmp_path / f"{view}_render.png"
        for file in files:
            Image.fromarray(rng.integers(0, 256, (40, 50, 3), dtype=np.uint8)).save(file)
        made.append(PicturePair(view, *files))
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
        check_pairs(pairs, "theirs")
        measure(pairs, Evaluator(PAPER, lpips=(), flip=False))


def test_pictures_too_large_to_be_measured_are_refused_by_their_header(tmp_path, monkeypatch):
    Image.new("1", (100, 100)).save(tmp_path / "a.png")
    pair = PicturePair("a", tmp_path / "a.png", tmp_path / "a.png")
    check_pairs([pair], "theirs")
    monkeypatch.setattr(pictures, "MAX_PIXELS", 9_999)
    with refusal("100x100 px: pictures of more than"):
        check_pairs([pair], "theirs")


def save_16_bits(pixels, path):
    """Write [H, W, 3] as a PNG of 16 bits, which Pillow cannot write."""
    height, width, _ = pixels.shape
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in pixels)
    head = struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0)
    content = b"\x89PNG\r\n\x1a\n"
    for kind, data in ((b"IHDR", head), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")):
        checked = kind + data
        content += struct.pack(">I", len(data)) + checked + struct.pack(">I", zlib.crc32(checked))
    path.write_bytes(content)


@pytest.mark.parametrize("grey", [True, False])
def test_sixteen_bits_are_rounded_to_the_nearest_level(grey, tmp_path):
    values = np.random.default_rng(0).integers(0, 2**16, (20, 30, 3)).astype(np.uint16)
    if grey:
        values = np.repeat(values[..., :1], 3, axis=2)
        Image.fromarray(values[..., 0]).save(tmp_path / "a.png")
    else:
        save_16_bits(values, tmp_path / "a.png")
    for is_render in (True, False):
        found = read_picture(tmp_path / "a.png", is_render)
        np.testing.assert_array_equal(found, np.round(values / 257))


def test_colours_of_a_transparent_render_are_as_stored_and_photographs_are_over_black(tmp_path):
    values = np.random.default_rng(0).integers(0, 256, (20, 30, 4)).astype(np.uint8)
    values[..., 3] = 128
    Image.fromarray(values).save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_picture(tmp_path / "a.png", True), values[..., :3])
    blended = read_picture(tmp_path / "a.png", False)
    np.testing.assert_allclose(blended, values[..., :3] * (128 / 255), atol=1)


def of_mode(mode):
    return lambda path: Image.open(path).convert(mode).save(path)


def transparent(path):
    image = Image.open(path)
    image.putalpha(200)
    image.save(path)


def as_jpeg(path):
    Image.open(path).save(path, format="JPEG")


def as_webp(path):
    Image.open(path).save(path, format="WEBP")


def turned(path):
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.open(path).save(path, exif=exif)


@pytest.mark.parametrize(
    "harm, of_render, said",
    [
        (transparent, True, "1 render with transparent pixels .* as they are stored .b."),
        (as_jpeg, True, "1 render compressed as JPEG .* .b.: write PNG"),
        (as_webp, True, "1 render compressed as JPEG or WebP"),
        (of_mode("P"), True, "1 render with a palette"),
        (of_mode("L"), True, "1 render in grey"),
        (turned, True, "1 photograph of another EXIF orientation"),
        (turned, False, "of another EXIF orientation"),
        (transparent, False, "1 photograph with transparent pixels, .* over black"),
        (as_jpeg, False, None),
        (of_mode("RGBA"), True, None),
    ],
)
def test_what_lowers_values_is_told_in_one_line(pairs, harm, of_render, said, caplog):
    harm(pairs[0].picture if of_render else pairs[0].photograph)
    lines = [odd.line for odd in check_pairs(pairs, "theirs")]
    assert len(lines) == (said is not None)
    if said is not None:
        assert re.search(said, lines[0])
        assert caplog.messages == [f"theirs: {lines[0]}"]


def test_a_photograph_on_its_side_is_named_if_the_sizes_differ(pairs):
    upright = Image.open(pairs[0].photograph)
    exif = Image.Exif()
    exif[0x0112] = 6
    upright.rotate(90, expand=True).save(pairs[0].photograph, exif=exif)
    with refusal("sizes are never changed here.*on its side .EXIF orientation 6.: turn"):
        check_pairs(pairs, "theirs")
