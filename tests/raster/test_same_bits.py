"""Three runs of a step with raster=triton and its loss kernel give the same bits.

The tests need a GPU; the tiny one also runs in Triton's interpreter. The first run uses new memory,
the second reuses it, and the third uses new objects with new memory pools.
"""

import pytest
import torch

from gsbench.bench.scenes import make_scene
from tests.raster.conftest import INTERPRETING

ON_A_GPU = torch.cuda.is_available()

pytestmark = pytest.mark.skipif(
    not (ON_A_GPU or INTERPRETING), reason="needs a GPU or Triton's interpreter"
)


@pytest.mark.gpu
@pytest.mark.parametrize(
    "width, height, count",
    [
        pytest.param(32, 16, 12, id="tiny"),
        pytest.param(
            1600,
            1060,
            100_000,
            id="full",
            marks=pytest.mark.skipif(not ON_A_GPU, reason="needs a GPU"),
        ),
    ],
)
def test_three_runs_give_the_same_bits(width, height, count):
    from gsbench.raster.triton.executor import TritonRasterizer
    from gsbench.train.loss_triton import TritonLoss

    device = "cuda" if ON_A_GPU else "cpu"
    gaussians, scene = make_scene("skewed", width, height, count)
    target = torch.from_numpy(scene.train[0].image).to(device)
    background = torch.zeros(3, device=device)

    def run(rasterizer, loss):
        leaves = gaussians.map(lambda tensor: tensor.to(device).requires_grad_())
        output = rasterizer.render(
            leaves, scene.train[0].camera, 3, background, absolute_gradient=True
        )
        value = loss(output.image, target)[0]
        value.backward()
        outputs = {
            "image": output.image,
            "alpha": output.alpha,
            "radii": output.radii,
            "loss": value,
        }
        outputs |= {"screen": output.screen_points.grad, "absolute": output.screen_gradient_abs}
        outputs |= {f"gradient of {name}": tensor.grad for name, tensor in leaves.tensors().items()}
        return {name: tensor.detach().cpu() for name, tensor in outputs.items()}

    rasterizer, loss = TritonRasterizer(), TritonLoss(0.2)
    first = run(rasterizer, loss)
    assert first["gradient of means"].abs().max() > 0  # otherwise, equal bits would prove nothing
    for other in (run(rasterizer, loss), run(TritonRasterizer(), TritonLoss(0.2))):
        assert [
            name for name, tensor in first.items() if not torch.equal(tensor, other[name])
        ] == []
