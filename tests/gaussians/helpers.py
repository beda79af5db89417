"""Small random sets of Gaussians and a camera that sees them."""

import numpy as np
import torch

from gsbench.gaussians.model import NUM_SH_REST, Gaussians
from gsbench.scene.types import Camera


def random_gaussians(count, seed=0, dtype=torch.float64, depth=(2.0, 6.0), log_scale=(-3.0, -1.0)):
    """Gaussians in front of ``front_camera``, of mixed sizes, shapes, opacities and colours."""
    rng = torch.Generator().manual_seed(seed)

    def uniform(low, high, *shape):
        return low + (high - low) * torch.rand(*shape, generator=rng, dtype=torch.float64)

    z = uniform(*depth, count)
    means = torch.stack([z * uniform(-0.6, 0.6, count), z * uniform(-0.5, 0.5, count), z], -1)
    return Gaussians(
        means=means,
        log_scales=uniform(*log_scale, count, 3),
        quaternions=torch.randn(count, 4, generator=rng, dtype=torch.float64),
        opacity_logits=uniform(-2.5, 2.5, count),
        sh_dc=torch.randn(count, 3, generator=rng, dtype=torch.float64),
        sh_rest=0.3 * torch.randn(count, NUM_SH_REST, 3, generator=rng, dtype=torch.float64),
    ).map(lambda tensor: tensor.to(dtype))


def leaves(gaussians, to=None):
    """A copy that requires gradients, of another type or on another device ``to`` if it is given."""
    return gaussians.map(lambda tensor: tensor.clone().to(to or tensor.dtype).requires_grad_())


def front_camera(width=40, height=30, shift=(0.0, 0.0)):
    """A camera near the origin, looking nearly along z; ``shift`` moves the principal point, px."""
    angle = 0.05
    rotation = np.array(
        [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    )
    intrinsics = (0.9 * width, 0.95 * width, width / 2 + shift[0], height / 2 + shift[1])
    return Camera(width, height, *intrinsics, rotation, np.array([0.1, -0.05, 0.2]))


def differences(one, other):
    """The names of the parameters whose bits differ between two sets."""
    others = other.tensors()
    return [name for name, value in one.tensors().items() if not torch.equal(value, others[name])]
