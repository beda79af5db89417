"""Scenes for the rasterizer tests: seeded ones of ordinary Gaussians, and hypothesis strategies of extreme ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from hypothesis import strategies as st
from torch import Tensor

from gsbench.gaussians.model import Gaussians
from gsbench.raster.base import Rasterizer, RenderOutput
from gsbench.scene.camera import Camera


@dataclass(frozen=True)
class Case:
    """One seeded scene with its camera; ``principal`` is the offset of the principal point in px."""

    width: int
    height: int
    count: int
    sh_degree: int
    principal: tuple[float, float] = (0.0, 0.0)
    log_scale: float = -2.0
    logit: float = 0.0

    def __str__(self) -> str:
        return f"{self.width}x{self.height}-n{self.count}-sh{self.sh_degree}"

    def camera(self) -> Camera:
        angle = 0.2
        rotation = np.array(
            [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]], dtype=np.float64
        )
        return Camera(
            self.width,
            self.height,
            1.1 * self.width,
            1.05 * self.width,
            self.width / 2 + self.principal[0],
            self.height / 2 + self.principal[1],
            rotation,
            np.array([0.1, -0.2, 0.3]),
        )

    def gaussians(self) -> Gaussians:
        """float64 values that float32 holds exactly; some lie behind the camera or outside the image."""
        generator = torch.Generator().manual_seed(self.width * 1000 + self.count)

        def normal(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=generator, dtype=torch.float64)

        means = normal(self.count, 3)
        means[:, 2] += 4
        gaussians = Gaussians(
            means,
            self.log_scale + 0.8 * normal(self.count, 3),
            normal(self.count, 4),
            self.logit + 2 * normal(self.count),
            0.7 * normal(self.count, 3),
            0.2 * normal(self.count, 15, 3),
        )
        return gaussians.map(lambda tensor: tensor.float().double())


def render_with_gradients(
    rasterizer: Rasterizer, case: Case, dtype: torch.dtype, device: str = "cpu"
) -> tuple[RenderOutput, dict[str, Tensor]]:
    """A render of ``case`` and the gradients of a fixed random weighting of the image and its alpha, in float64."""
    gaussians = case.gaussians().map(lambda tensor: tensor.to(device, dtype).requires_grad_())
    background = torch.tensor([0.2, 0.5, 0.9], dtype=dtype, device=device)
    output = rasterizer.render(gaussians, case.camera(), case.sh_degree, background, absolute_gradient=True)
    generator = torch.Generator().manual_seed(7)
    weights = torch.randn(case.height, case.width, 4, generator=generator, dtype=torch.float64).to(device, dtype)
    ((output.image * weights[..., :3]).sum() + (output.alpha * weights[..., 3]).sum()).backward()
    gradients = {name: tensor.grad for name, tensor in gaussians.tensors().items()}
    gradients |= {"screen_points": output.screen_points.grad, "screen_gradient_abs": output.screen_gradient_abs}
    return output, {
        name: torch.zeros(()) if gradient is None else gradient.detach().cpu().double()
        for name, gradient in gradients.items()
    }


_PLACES = st.sampled_from([-1e6, -50.0, -1.0, 0.0, 1e-3, 0.2, 0.20001, 0.5, 3.0, 1e3, 1e6])
_SCALES = st.sampled_from([1e-12, 1e-6, 1e-2, 1.0, 1e3, 1e6])
_LOGITS = st.sampled_from([-100.0, -6.0, 0.0, 5.0, 100.0])


@st.composite
def extreme_gaussians(draw: st.DrawFn) -> Gaussians:
    """0 to 6 float32 Gaussians behind, on, or far outside the frustum, from vanishing to larger than the world."""
    count = draw(st.integers(0, 6))

    def rows(elements: st.SearchStrategy[float], width: int) -> Tensor:
        values = draw(st.lists(elements, min_size=count * width, max_size=count * width))
        return torch.tensor(values, dtype=torch.float32).reshape(count, width)

    generator = torch.Generator().manual_seed(draw(st.integers(0, 100)))
    return Gaussians(
        rows(_PLACES, 3),
        rows(_SCALES, 3).log(),
        torch.randn(count, 4, generator=generator),
        rows(_LOGITS, 1).reshape(count),
        torch.randn(count, 3, generator=generator),
        torch.randn(count, 15, 3, generator=generator),
    )
