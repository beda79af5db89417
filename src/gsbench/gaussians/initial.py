"""The initial Gaussians of a training, made from a point cloud as in 3DGS."""

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gsbench.errors import InputError
from gsbench.gaussians.model import NUM_SH_REST, Gaussians, rgb_to_dc

NEIGHBOURS = 3
# world units^2; lower limit of the mean squared distance to neighbours, as in 3DGS
MIN_SQUARED_DISTANCE = 1e-7
INITIAL_OPACITY = 0.1


def gaussians_from_cloud(
    points: NDArray[np.float64], colors: NDArray[np.uint8], device: torch.device | str = "cpu"
) -> Gaussians:
    """Make one isotropic Gaussian at each of ``points`` [P, 3] of ``colors`` [P, 3] (0 to 255).

    The standard deviation is the root of the mean *squared* distance to the 3 nearest other points
    (simple-knn of 3DGS). Raises InputError if there are fewer than 4 points or points that are not
    finite.
    """
    if len(points) <= NEIGHBOURS:
        raise InputError(
            f"the initial cloud has {len(points)} points, at least {NEIGHBOURS + 1} are needed"
        )
    if not np.isfinite(points).all():
        raise InputError(
            "the initial cloud has points that are not finite; rebuild it or clean the COLMAP model"
        )
    # [P, 4]; the first neighbour is the point itself
    distances, _ = cKDTree(points).query(points, k=NEIGHBOURS + 1)
    squared = np.maximum((distances[:, 1:] ** 2).mean(axis=1), MIN_SQUARED_DISTANCE)  # [P]
    n = len(points)
    log_scales = torch.from_numpy(0.5 * np.log(squared)).float()
    logit = float(np.log(INITIAL_OPACITY / (1 - INITIAL_OPACITY)))
    return Gaussians(
        means=torch.from_numpy(np.asarray(points)).float(),
        log_scales=log_scales.unsqueeze(-1).repeat(1, 3),
        quaternions=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
        opacity_logits=torch.full((n,), logit),
        sh_dc=rgb_to_dc(torch.from_numpy(np.asarray(colors)).float() / 255),
        sh_rest=torch.zeros(n, NUM_SH_REST, 3),
    ).map(lambda tensor: tensor.to(device))
