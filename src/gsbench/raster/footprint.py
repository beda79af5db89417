"""Footprints, the pixels that each Gaussian covers in one view: some densifiers ask a rasterizer for them."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from gsbench.gaussians.model import Gaussians
from gsbench.scene.camera import Camera


@dataclass(frozen=True)
class Footprint:
    """The pixels of one view that each Gaussian is blended into: those where its alpha is not skipped and that have not
    stopped before it.

    All are [N] and carry no gradient; where there is no such pixel, all but ``depths`` are 0.
    """

    pixels: Tensor  # int32, how many
    depths: Tensor  # view z of the mean, world units
    values: Tensor  # sum over them of the values that were asked about; 0 where none were
    distances: Tensor  # sum over them of the distance from the projected mean to the pixel's centre, px


def view_depths(gaussians: Gaussians, camera: Camera) -> Tensor:
    """View z of each mean, [N] world units."""
    return gaussians.means.detach() @ gaussians.means.new_tensor(camera.rotation[2]) + camera.translation[2]
