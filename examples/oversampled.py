"""A rasterizer; docs/rasterizer.md says how to run it."""

from dataclasses import dataclass, replace

import torch
from pydantic import PositiveInt

from gsbench.raster.reference import ReferenceRasterizer


@dataclass
class Oversampled:
    """Renders at a multiple of the image's size, and takes means of its pixels."""

    factor: PositiveInt = 2
    name = "oversampled"  # its name in results and tables; no annotation, so no setting

    def render(self, gaussians, camera, sh_degree, background, absolute_gradient=False):
        numbers = ("width", "height", "fx", "fy", "cx", "cy")
        larger = replace(camera, **{key: self.factor * getattr(camera, key) for key in numbers})
        out = ReferenceRasterizer().render(
            gaussians, larger, sh_degree, background, absolute_gradient
        )
        planes = torch.cat([out.image, out.alpha[..., None]], -1).permute(2, 0, 1)  # [4, H, W]
        small = torch.nn.functional.avg_pool2d(planes, self.factor).permute(1, 2, 0)
        radii = (out.radii / self.factor).ceil().int()
        return replace(out, image=small[..., :3], alpha=small[..., 3], radii=radii, footprint=None)
