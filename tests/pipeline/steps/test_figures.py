"""The overlay draws what it says: one outline, of the right Gaussian, in its place, in the colour of its cause."""

from __future__ import annotations

import math

import numpy as np
import torch
from PIL import Image

from gsbench.events import Cause
from gsbench.gaussians.model import Gaussians
from gsbench.pipeline.steps.evaluate import _with_legend, draw_ellipsoids
from tests.train.conftest import orbit_camera


def test_only_the_voluminous_is_outlined() -> None:
    scales = torch.tensor([[1.0, 1.0, 1.0], [0.01, 0.01, 0.01]])
    gaussians = Gaussians(
        means=torch.tensor([[0.0, 0.0, 4.0], [1.0, 0.5, 4.0]]),
        log_scales=scales.log(),
        quaternions=torch.tensor([[1.0, 0, 0, 0]] * 2),
        opacity_logits=torch.zeros(2),
        sh_dc=torch.zeros(2, 3),
        sh_rest=torch.zeros(2, 15, 3),
    )
    camera = orbit_camera(0.0)
    causes = torch.tensor([int(Cause.SPLIT_VOLUME), int(Cause.CLONE)])
    black = np.zeros((camera.height, camera.width, 3), dtype=np.uint8)
    picture = np.asarray(draw_ellipsoids(black, gaussians, causes, camera, 0.03))
    drawn, legend = np.split(picture, [camera.height])
    assert len(legend) % 14 == 0  # px of a line
    in_legend = {tuple(color) for color in legend.reshape(-1, 3).tolist()}
    assert Cause.SPLIT_VOLUME.color in in_legend
    assert Cause.CLONE.color not in in_legend
    rows, columns = np.nonzero(drawn.any(-1))
    assert {tuple(color) for color in drawn[rows, columns].tolist()} == {Cause.SPLIT_VOLUME.color}
    radius = math.sqrt((1.0 * camera.fx / 4) ** 2 + 0.3)  # one standard deviation and the blur, px
    distances = np.hypot(columns - (camera.cx - 0.5), rows - (camera.cy - 0.5))
    assert np.abs(distances - radius).max() < 1.5  # a line of pixels
    assert abs(distances.mean() - radius) < 0.3
    assert abs(columns.mean() - (camera.cx - 0.5)) < 0.3
    assert abs(rows.mean() - (camera.cy - 0.5)) < 0.3


def test_a_word_wider_than_the_picture_leaves_no_line_empty() -> None:
    wide, narrow = (_with_legend(Image.new("RGB", (width, 10)), "illegible", []).height for width in (500, 5))
    assert narrow == wide
    assert _with_legend(Image.new("RGB", (5, 10)), "illegible too", []).height - wide == wide - 10  # a line each
