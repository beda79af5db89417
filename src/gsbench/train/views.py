"""The training views: their order, their images on the device, and renders of them."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from gsbench.eval.images import as_unit_range, replace_ignored
from gsbench.eval.ssim import ssim_map
from gsbench.gaussians.model import Gaussians
from gsbench.raster import Rasterizer, RenderOutput
from gsbench.scene.types import View
from gsbench.train.loss import PhotometricLoss
from gsbench.words import readable_bytes

log = logging.getLogger(__name__)

# every random number of a training comes from one of these streams
STREAMS = ("cameras", "densify", "ideas")


def generators(seed: int) -> dict[str, torch.Generator]:
    """A CPU generator for each of `STREAMS`, independent of each other and of other seeds."""
    found = {}
    for number, name in enumerate(STREAMS):
        (state,) = np.random.SeedSequence([seed, number]).generate_state(1, np.uint64)
        # 63 bits: torch takes seeds below 2^63.
        found[name] = torch.Generator().manual_seed(int(state >> np.uint64(1)))
    return found


class CameraOrder:
    """Draws training views at random without replacement; when all were drawn, it starts again."""

    def __init__(self, num_views: int, rng: torch.Generator) -> None:
        self.num_views = num_views
        self.rng = rng
        self.remaining: list[int] = []

    def next(self) -> int:
        if not self.remaining:
            self.remaining = torch.randperm(self.num_views, generator=self.rng).tolist()
        return self.remaining.pop()


class Targets:
    """The images of ``views`` on ``device``, [H, W, 3] uint8 each.

    If all images fit into ``budget`` bytes (None: no limit), they stay on the device; otherwise
    `get` copies each. On a CPU they share memory with the views. Masks, which need a third of the
    memory of images, always stay on the device.
    """

    def __init__(
        self, views: Sequence[View], device: torch.device, budget: int | None = None
    ) -> None:
        self._images = [torch.from_numpy(view.image) for view in views]
        self._masks = [
            None if view.mask is None else torch.from_numpy(view.mask).to(device)[..., None]
            for view in views
        ]
        self._device = device
        self.bytes = sum(image.numel() for image in self._images)
        self.resident = budget is None or self.bytes <= budget
        if self.resident:
            self._images = [image.to(device) for image in self._images]
        else:
            log.info(
                "the %d training images (%s) leave too little memory on %s: each is copied when "
                "it is needed",
                len(self._images),
                readable_bytes(self.bytes),
                device,
            )

    def mask(self, index: int) -> Tensor | None:
        """The mask of view ``index``, [H, W, 1] on the device, True where a pixel counts.

        None if all pixels count.
        """
        return self._masks[index]

    def get(self, index: int) -> Tensor:
        """The image of view ``index`` on the device.

        The copy may not be complete: use the image only in work that is queued after this call.
        """
        image = self._images[index]
        if self.resident or self._device.type != "cuda":
            return image
        # A copy is asynchronous only from page-locked memory.
        return image.pin_memory().to(self._device, non_blocking=True)


@dataclass(frozen=True)
class SceneViews:
    """Training views for densifiers, rendered and measured as in training.

    This class implements `gsbench.densify.scores.TrainingViews`. Pixels that a mask ignores are
    replaced by those of the photograph, so they have no error and no gradient.
    """

    views: Sequence[View]
    targets: Targets
    rasterizer: Rasterizer
    background: Tensor
    photometric_loss: PhotometricLoss
    sh_degree: Callable[[int], int]  # degree of spherical harmonics at an iteration

    def __len__(self) -> int:
        return len(self.views)

    def image(self, index: int) -> Tensor:
        return self.targets.get(index)

    def render(self, index: int, gaussians: Gaussians, step: int) -> RenderOutput:
        camera, degree = self.views[index].camera, self.sh_degree(step)
        render = self.rasterizer.render(gaussians, camera, degree, self.background)
        mask = self.targets.mask(index)
        if mask is None:
            return render
        return replace(render, image=replace_ignored(render.image, self.targets.get(index), mask))

    def dissimilarity(self, index: int, image: Tensor) -> Tensor:
        target = as_unit_range(self.targets.get(index), image.dtype)
        return (1 - ssim_map(image, target).mean(0)).clamp_min(0)

    def loss(self, index: int, image: Tensor) -> Tensor:
        return self.photometric_loss(image, self.targets.get(index))[0].detach()
