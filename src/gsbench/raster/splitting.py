"""The splitting matrix of each Gaussian, an extra output of three executors (SteepGS, 2505.05587).

It is [3, 3] per world unit squared: the sum over pixels of (d loss / d s) times the second
derivative of s by the mean. s is the opacity times the density at the pixel, before the clamp to
``alpha_max``. Here the projection is linearised and the 2D covariance is constant.

This module has the definition, for the reference. The compiled executors compute the same from the
sums of the backward pass (`raster.formulas.splitting_entries`).
"""

import torch
from torch import Tensor

from gsbench.scene.types import Camera

SPLITTING_MATRIX = {"splitting_matrix": (3, 3)}  # the name of the output, and its shape


def on_image(probe: Tensor, means: Tensor, camera: Camera) -> Tensor:
    """The ``probe`` [M, 3, 3] of Gaussians with ``means`` [M, 3] on the image, [M, 2, 2]."""
    jacobians = mean_jacobians(means, camera)  # [M, 2, 3]
    return jacobians @ probe @ jacobians.mT


def mean_jacobians(means: Tensor, camera: Camera) -> Tensor:
    """The Jacobians [M, 2, 3] of the projected means, px, by ``means`` [M, 3].

    Unlike those of the covariances, they have no limits on the slopes.
    """
    rotation = means.new_tensor(camera.rotation)  # [3, 3]
    # each [M, 1]
    x, y, z = (means @ rotation.T + means.new_tensor(camera.translation)).unsqueeze(-1).unbind(1)
    row_x = camera.fx / z * (rotation[0] - x / z * rotation[2])  # [M, 3]
    row_y = camera.fy / z * (rotation[1] - y / z * rotation[2])
    return torch.stack([row_x, row_y], 1)


def probed(heights: Tensor, offsets: Tensor, conics: Tensor, image_probe: Tensor) -> Tensor:
    """The ``heights`` s [P, K] plus zero, whose gradient by ``image_probe`` [K, 2, 2] is wanted.

    This gradient is the sum over pixels of (d loss / d s) times the second derivative of s by the
    projected mean. ``offsets`` [P, K, 2] are those of the means from the pixels; ``conics`` [K, 3].
    """
    inverse = conics.detach()[:, [0, 1, 1, 2]].reshape(-1, 2, 2)  # [K, 2, 2]
    slope = (inverse @ offsets.detach().unsqueeze(-1)).squeeze(-1)  # [P, K, 2]
    second = slope.unsqueeze(-1) * slope.unsqueeze(-2) - inverse  # [P, K, 2, 2]
    return heights + heights.detach() * (second * image_probe).sum((-2, -1))
