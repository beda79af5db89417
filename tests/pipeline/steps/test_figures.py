"""The overlay outlines the right Gaussians, in the right place and colour."""

import math

import numpy as np
import pytest
import torch
from numpy.testing import assert_array_equal
from PIL import Image, ImageDraw, ImageFont

from gsbench.events import Cause
from gsbench.gaussians.model import Gaussians
from gsbench.pipeline.steps import evaluate
from gsbench.pipeline.steps.evaluate import _with_legend, draw_ellipsoids
from tests.train.conftest import orbit_camera


def two_gaussians(means, log_scales):
    return Gaussians(
        means=torch.tensor(means),
        log_scales=log_scales,
        quaternions=torch.tensor([[1.0, 0, 0, 0]] * 2),
        opacity_logits=torch.zeros(2),
        sh_dc=torch.zeros(2, 3),
        sh_rest=torch.zeros(2, 15, 3),
    )


def test_only_voluminous_gaussians_are_outlined():
    scales = torch.tensor([[1.0, 1.0, 1.0], [0.01, 0.01, 0.01]])
    gaussians = two_gaussians([[0.0, 0.0, 4.0], [1.0, 0.5, 4.0]], scales.log())
    camera = orbit_camera(0.0)
    causes = torch.tensor([int(Cause.SPLIT_VOLUME), int(Cause.CLONE)])
    black = np.zeros((camera.height, camera.width, 3), dtype=np.uint8)
    picture = np.asarray(draw_ellipsoids(black, gaussians, causes, camera, 0.03))
    drawn, legend = np.split(picture, [camera.height])
    assert len(legend) % 14 == 0  # px, the height of a line
    in_legend = {tuple(color) for color in legend.reshape(-1, 3).tolist()}
    assert Cause.SPLIT_VOLUME.color in in_legend
    assert Cause.CLONE.color not in in_legend
    rows, columns = np.nonzero(drawn.any(-1))
    assert {tuple(color) for color in drawn[rows, columns].tolist()} == {Cause.SPLIT_VOLUME.color}
    radius = math.sqrt((1.0 * camera.fx / 4) ** 2 + 0.3)  # one standard deviation and the blur, px
    distances = np.hypot(columns - (camera.cx - 0.5), rows - (camera.cy - 0.5))
    assert np.abs(distances - radius).max() < 1.5  # the outline is about one pixel wide
    assert abs(distances.mean() - radius) < 0.3
    assert abs(columns.mean() - (camera.cx - 0.5)) < 0.3
    assert abs(rows.mean() - (camera.cy - 0.5)) < 0.3
    angles = np.sort(np.arctan2(rows - (camera.cy - 0.5), columns - (camera.cx - 0.5)))
    assert np.diff(angles, append=angles[0] + math.tau).max() < 0.3  # the outline is closed


def test_of_too_many_gaussians_the_most_voluminous_are_outlined(monkeypatch):
    monkeypatch.setattr(evaluate, "MAX_OUTLINES", 1)
    gaussians = two_gaussians([[0.0, 0.0, 4.0]] * 2, torch.tensor([[-0.5] * 3, [0.0] * 3]))
    camera = orbit_camera(0.0)
    causes = torch.tensor([int(Cause.CLONE), int(Cause.ADDED)])
    black = np.zeros((camera.height, camera.width, 3), dtype=np.uint8)
    drawn = np.asarray(draw_ellipsoids(black, gaussians, causes, camera, 0.03))[: camera.height]
    assert {tuple(color) for color in drawn[drawn.any(-1)].tolist()} == {Cause.ADDED.color}


@pytest.mark.parametrize("words_in_a_line", [3, 2, 1])
def test_the_legend_below_the_picture_is_wrapped(words_in_a_line):
    """The font has 11 px, words are 5 px apart, lines 14 px high, and the margin is 2 px."""
    font = ImageFont.load_default(11)
    words = [
        ("title", (255, 255, 255)),
        ("word", (255, 255, 255)),
        (Cause.CLONE.words, Cause.CLONE.color),
    ]
    first, second, third = (math.ceil(font.getlength(text)) + 5 for text, _ in words)
    width, at = {
        3: (first + second + third, [(2, 0), (2 + first, 0), (2 + first + second, 0)]),
        2: (first + second, [(2, 0), (2 + first, 0), (2, 1)]),
        1: (5, [(2, 0), (2, 1), (2, 2)]),
    }[words_in_a_line]
    image = Image.fromarray(np.full((10, width, 3), 90, dtype=np.uint8))
    expected = Image.new("RGB", (width, 10 + 14 * (at[-1][1] + 1)))
    expected.paste(image, (0, 0))
    for (text, color), (left, line) in zip(words, at, strict=True):
        ImageDraw.Draw(expected).text((left, 10 + 14 * line), text, fill=color, font=font)
    assert_array_equal(_with_legend(image, "title word", [Cause.CLONE]), expected)
