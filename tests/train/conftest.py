"""A scene small enough to train on in a second."""

import numpy as np
import pytest
import torch

from gsbench.raster import create_rasterizer
from gsbench.raster.reference import ReferenceRasterizer
from gsbench.scene.types import Camera, Scene, View
from tests.gaussians.helpers import random_gaussians
from tests.train.lab import CPU, Lab


def orbit_camera(angle, width=40, height=32):
    """A camera on a circle of radius 4 around (0, 0, 4) that looks at its centre."""
    center = np.array([4 * np.sin(angle), 0.0, 4 - 4 * np.cos(angle)])
    forward = (np.array([0.0, 0.0, 4.0]) - center) / 4
    right = np.cross(np.array([0.0, 1.0, 0.0]), forward)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Camera(width, height, 40.0, 40.0, width / 2, height / 2, rotation, -rotation @ center)


@pytest.fixture(scope="session")
def truth():
    gaussians = random_gaussians(
        80, seed=2, dtype=torch.float32, log_scale=(-2.5, -1.0), depth=(3.0, 5.0)
    )
    gaussians.opacity_logits += 2
    return gaussians


@pytest.fixture(scope="session")
def tiny_scene(truth):
    """Ten views of ``truth`` at 40x32; the first and the ninth are held out."""
    views = []
    for i, angle in enumerate(np.linspace(-0.6, 0.6, 10)):
        camera = orbit_camera(float(angle))
        with torch.no_grad():
            image = ReferenceRasterizer().render(truth, camera, 0, torch.zeros(3)).image
        views.append(
            View(f"{i:02d}.png", camera, (image.clamp(0, 1) * 255).round().to(torch.uint8).numpy())
        )
    test = {0, 8}
    return Scene(
        "tiny",
        train=tuple(view for i, view in enumerate(views) if i not in test),
        test=tuple(view for i, view in enumerate(views) if i in test),
    )


@pytest.fixture
def lab(tiny_scene, truth, tmp_path):
    return Lab(tiny_scene, truth, create_rasterizer("cpu", CPU, threads=1), tmp_path)
