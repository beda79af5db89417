"""Three runs of a step with raster=triton and its loss kernel give the same bits.

The tests need a GPU; the tiny one also runs in Triton's interpreter. The first run uses new memory,
the second reuses it, and the third uses new objects with new memory pools.
"""

import pytest
import torch

from gsbench.bench.scenes import make_scene
from tests.gaussians.helpers import leaves
from tests.raster.conftest import INTERPRETING

ON_A_GPU = torch.cuda.is_available()

pytestmark = pytest.mark.skipif(
    not (ON_A_GPU or INTERPRETING), reason="needs a GPU or Triton's interpreter"
)


@pytest.mark.gpu
@pytest.mark.parametrize(
    "width, height, count",
    [
        pytest.param(32, 16, 12, id="tiny"),  # scripts/gpu_day.py chooses it by this name
        pytest.param(
            *(1600, 1060, 100_000),
            id="full",
            marks=pytest.mark.skipif(not ON_A_GPU, reason="needs a GPU"),
        ),
    ],
)
def test_three_runs_give_the_same_bits(width, height, count):
    from gsbench.raster.triton.executor import TritonRasterizer
    from gsbench.train.loss_triton import TritonLoss

    device = "cuda" if ON_A_GPU else "cpu"
    gaussians, scene = make_scene("crowded", width, height, count)
    target = torch.from_numpy(scene.train[0].image).to(device)
    background = torch.zeros(3, device=device)

    def run(rasterizer, loss):
        own = leaves(gaussians, device)
        camera = scene.train[0].camera
        output = rasterizer.render(own, camera, 3, background, absolute_gradient=True)
        value = loss(output.image, target)[0]
        value.backward()
        found = {name: tensor.grad for name, tensor in own.tensors().items()}
        found |= {name: getattr(output, name) for name in ("image", "alpha", "radii")}
        found |= {"loss": value, "screen": output.screen_points.grad}
        found["absolute"] = output.screen_gradient_abs
        return {name: tensor.detach().cpu() for name, tensor in found.items()}

    rasterizer, loss = TritonRasterizer(), TritonLoss(0.2)
    first = run(rasterizer, loss)
    assert first["means"].abs().max() > 0  # otherwise, equal bits would prove nothing
    for other in (run(rasterizer, loss), run(TritonRasterizer(), TritonLoss(0.2))):
        assert [name for name in first if not torch.equal(first[name], other[name])] == []
