"""Scenes for timing: synthetic Gaussians, the same on every machine, or a trained model."""

import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gsbench.gaussians.model import NUM_SH_REST, Gaussians
from gsbench.gaussians.ply import read_ply
from gsbench.scene.types import Camera, Scene, View

SEED = 0
FOCAL = 0.9  # of the image width
VIEWS = 2
FIRST_DEPTH, DEPTH_RATIO = 2.0, 12.0  # trained-like scene: least depth, and largest / least depth
# Standard deviation of the median Gaussian of 100,000, in units of depth: 1.6 px in an image 500 px
# wide.
MEDIAN_SIGMA = 1.6 / (FOCAL * 500)
SIGMA_EXPONENT = 0.4  # sigma is proportional to count^-0.4: many Gaussians are smaller
SIGMA_SPREAD = 0.7  # standard deviation of log sigma
# Crowded scene: share of Gaussians over one tile, and its side in units of the field of view's.
CROWD_SHARE, CROWD_SIDE = 0.05, 0.007


def trained_like_gaussians(count: int) -> Gaussians:
    """Make ``count`` Gaussians like those of a trained model.

    Many are small and flat, a few are large, and opacities vary. They fill the view of
    `frontal_camera` and a margin around it.
    """
    generator = torch.Generator().manual_seed(SEED)
    depth = FIRST_DEPTH * (torch.rand(count, generator=generator) * math.log(DEPTH_RATIO)).exp()
    fields = torch.tensor([1.4, 1.05])
    slopes = (torch.rand(count, 2, generator=generator) - 0.5) * fields  # [N, 2] x/z, y/z
    spread = torch.exp(SIGMA_SPREAD * torch.randn(count, generator=generator))
    sigma = MEDIAN_SIGMA * (100_000 / count) ** SIGMA_EXPONENT * spread * depth
    flat = torch.tensor([0.0, 0.0, 1.5])
    shape = 0.5 * torch.randn(count, 3, generator=generator) - flat  # [N, 3]
    return Gaussians(
        means=torch.cat([slopes * depth[:, None], depth[:, None]], 1),
        log_scales=sigma.log()[:, None] + shape,
        quaternions=torch.randn(count, 4, generator=generator),
        opacity_logits=2.2 * torch.randn(count, generator=generator) - 0.5,
        sh_dc=0.6 * torch.randn(count, 3, generator=generator),
        sh_rest=0.1 * torch.randn(count, NUM_SH_REST, 3, generator=generator),
    )


def crowded_gaussians(count: int) -> Gaussians:
    """Make `trained_like_gaussians`, but a twentieth of them is over one tile near the middle.

    So it is in a picture of 1600x1060 px. There the longest list is several hundred times the mean;
    a rasterizer in which one program composites a list is as slow as this one.
    """
    gaussians = trained_like_gaussians(count)
    slopes = gaussians.means[:, :2] / gaussians.means[:, 2:]  # [N, 2]
    # Moved to one side of the middle, which is often a border between tiles.
    crowded = CROWD_SIDE * (slopes - slopes.amin(0)) * gaussians.means[:, 2:]
    moved = torch.arange(count) < CROWD_SHARE * count  # [N]; the first are as random as the others
    gaussians.means[:, :2] = torch.where(moved[:, None], crowded, gaussians.means[:, :2])
    return gaussians


SCENES = {
    "trained": trained_like_gaussians,
    "crowded": crowded_gaussians,
}


def make_scene(
    kind: str, width: int, height: int, count: int, ply: Path | None = None
) -> tuple[Gaussians, Scene]:
    """Make Gaussians and a scene of noise images for them.

    The Gaussians are those of the model ``ply``, else ``count`` of a ``kind`` in `SCENES`.
    """
    if ply is not None:
        gaussians = read_ply(ply)
        camera = camera_before(gaussians, width, height)
    else:
        gaussians, camera = SCENES[kind](count), frontal_camera(width, height)
    noise = np.random.default_rng(SEED)
    images = [noise.integers(0, 256, (height, width, 3), dtype=np.uint8) for _ in range(VIEWS)]
    return gaussians, Scene(
        "bench", tuple(View(f"{k}.png", camera, image) for k, image in enumerate(images)), ()
    )


def frontal_camera(
    width: int, height: int, translation: tuple[float, ...] | np.ndarray = (0.0, 0.0, 0.0)
) -> Camera:
    """A camera that looks along z, by default at the origin."""
    focal = FOCAL * width
    return Camera(
        width, height, focal, focal, width / 2, height / 2, np.eye(3), np.array(translation)
    )


def camera_before(scene: Gaussians, width: int, height: int) -> Camera:
    """A camera that looks along z at the middle of ``scene``.

    Its distance from there is twice the median distance of the Gaussians.
    """
    center: Tensor = scene.means.median(0).values  # [3]
    distance = (scene.means - center).norm(dim=-1).median().item()
    translation = np.array([0.0, 0.0, 2 * distance]) - center.double().numpy()
    return frontal_camera(width, height, translation)
