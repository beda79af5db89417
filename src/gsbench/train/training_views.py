"""The training views as a densifier looks at them between two iterations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from torch import Tensor

from gsbench.eval.images import as_unit_range, where_counted
from gsbench.eval.ssim import ssim_map
from gsbench.gaussians.model import Gaussians
from gsbench.raster import Rasterizer, RenderOutput
from gsbench.scene.types import View
from gsbench.train.loss import PhotometricLoss
from gsbench.train.targets import Targets


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
