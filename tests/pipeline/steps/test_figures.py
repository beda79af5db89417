"""The overlay outlines the right Gaussians, in the right place and colour."""

import math

import numpy as np
import torch

from gsbench.events import Cause
from gsbench.gaussians.model import Gaussians
from gsbench.pipeline.steps import evaluate
from gsbench.pipeline.steps.evaluate import draw_ellipsoids
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
    assert len(legend) == 2 * 14  # px: lines of the title and of one cause
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
