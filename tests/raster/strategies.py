"""Hypothesis strategies for extreme scenes; ordinary ones are in ``gsbench.raster.contract``."""

import torch
from hypothesis import strategies as st

from gsbench.gaussians.model import Gaussians

_PLACES = st.sampled_from([-1e6, -50.0, -1.0, 0.0, 1e-3, 0.2, 0.20001, 0.5, 3.0, 1e3, 1e6])
_SCALES = st.sampled_from([1e-12, 1e-6, 1e-2, 1.0, 1e3, 1e6])
_LOGITS = st.sampled_from([-100.0, -6.0, 0.0, 5.0, 100.0])


@st.composite
def extreme_gaussians(draw):
    """0 to 6 float32 Gaussians of any size, in, behind or far outside the frustum."""
    count = draw(st.integers(0, 6))

    def rows(elements, width):
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
