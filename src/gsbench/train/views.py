"""The training views: their random order, their images on the device, and what densifiers see of them."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from gsbench.eval.images import as_unit_range, where_counted
from gsbench.eval.ssim import ssim_map
from gsbench.gaussians.model import Gaussians
from gsbench.raster import Rasterizer, RenderOutput
from gsbench.scene.types import View
from gsbench.train.loss import PhotometricLoss
from gsbench.words import readable_bytes

STREAMS = ("cameras", "densify")  # every random draw of a training belongs to one


def generators(seed: int) -> dict[str, torch.Generator]:
    """A CPU generator for each of `STREAMS`; streams of all seeds are independent."""
    return {name: generator(seed, stream) for stream, name in enumerate(STREAMS)}


def generator(seed: int, stream: int) -> torch.Generator:
    """A CPU generator for one stream of a trial's randomness; streams of all seeds are independent."""
    state = np.random.SeedSequence([seed, stream]).generate_state(1, np.uint64)[0]
    return torch.Generator().manual_seed(int(state >> np.uint64(1)))


class CameraOrder:
    """Training views in random order without replacement, drawn anew when all were used."""

    def __init__(self, num_views: int, rng: torch.Generator) -> None:
        self.num_views = num_views
        self.rng = rng
        self.remaining: list[int] = []

    def next(self) -> int:
        if not self.remaining:
            self.remaining = torch.randperm(self.num_views, generator=self.rng).tolist()
        return self.remaining.pop()


log = logging.getLogger(__name__)


class Targets:
    """The images of ``views`` on ``device``, [H, W, 3] uint8 each.

    They stay on the device where all of them fit into ``budget`` bytes (None: no limit). Else each is copied there when
    it is asked for. On a CPU they are the arrays of the views themselves. Masks, a third of that where there are any,
    are always there.
    """

    def __init__(self, views: Sequence[View], device: torch.device, budget: int | None = None) -> None:
        self._images = [torch.from_numpy(view.image) for view in views]
        self._masks = [
            None if view.mask is None else torch.from_numpy(view.mask).to(device)[..., None] for view in views
        ]
        self._device = device
        self.bytes = sum(image.numel() for image in self._images)
        self.resident = budget is None or self.bytes <= budget
        if self.resident:
            self._images = [image.to(device) for image in self._images]
        else:
            log.info(
                "the %d training images (%s) leave too little memory on %s: each is copied when it is needed",
                len(self._images), readable_bytes(self.bytes), device,
            )  # fmt: skip

    def mask(self, index: int) -> Tensor | None:
        """The mask of view ``index``, True where a pixel counts, [H, W, 1] on the device; None where all do."""
        return self._masks[index]

    def get(self, index: int) -> Tensor:
        """The image of view ``index``, for work that is queued from here on."""
        image = self._images[index]
        if self.resident or self._device.type != "cuda":
            return image
        return image.pin_memory().to(self._device, non_blocking=True)  # page-locked, so that the host need not wait


class SceneViews:
    """The views of a scene, rendered and measured as the training does it; see `gsbench.densify.scores.TrainingViews`.

    ``sh_degree`` says which degree of harmonics an iteration renders with. Pixels that a mask ignores are rendered as
    the photograph has them, without error or gradient.
    """

    def __init__(
        self,
        views: Sequence[View],
        targets: Targets,
        rasterizer: Rasterizer,
        background: Tensor,
        loss: PhotometricLoss,
        sh_degree: Callable[[int], int],
    ) -> None:
        self._views, self._targets, self._rasterizer = views, targets, rasterizer
        self._background, self._loss, self._sh_degree = background, loss, sh_degree

    def __len__(self) -> int:
        return len(self._views)

    def image(self, index: int) -> Tensor:
        return self._targets.get(index)

    def render(self, index: int, gaussians: Gaussians, step: int) -> RenderOutput:
        camera, degree = self._views[index].camera, self._sh_degree(step)
        render = self._rasterizer.render(gaussians, camera, degree, self._background)
        mask = self._targets.mask(index)
        if mask is None:
            return render
        return replace(render, image=where_counted(render.image, self._targets.get(index), mask))

    def dissimilarity(self, index: int, image: Tensor) -> Tensor:
        target = as_unit_range(self._targets.get(index), image.dtype)
        return (1 - ssim_map(image, target).mean(0)).clamp_min(0)

    def loss(self, index: int, image: Tensor) -> Tensor:
        return self._loss(image, self._targets.get(index))[0].detach()
