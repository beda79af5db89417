"""The loss with a mask: ignored pixels add nothing and have no gradient.

The other pixels have the same weight as without a mask.
"""

import numpy as np
import pytest
import torch

from gsbench.eval.images import replace_ignored
from gsbench.raster import create_rasterizer
from gsbench.scene.types import Camera, View
from gsbench.train.loss import PhotometricLoss
from gsbench.train.views import SceneViews, Targets
from tests.eval.reference import ssim_map

HEIGHT, WIDTH = 37, 53
CAMERA = Camera(
    WIDTH, HEIGHT, 50.0, 50.0, WIDTH / 2, HEIGHT / 2, np.eye(3), np.array([0.0, 0.0, 3.0])
)


@pytest.fixture
def picture():
    """A render, a photograph, and a mask [H, W, 1] that ignores a disc and the right margin."""
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(HEIGHT, WIDTH, 3, generator=generator)
    target = (torch.rand(HEIGHT, WIDTH, 3, generator=generator) * 255).to(torch.uint8)
    rows, columns = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    mask = ((rows - 18) ** 2 + (columns - 20) ** 2 > 81) & (columns < 45)
    return image, target, mask[..., None]


def test_the_loss_with_a_mask_matches_its_definition(picture):
    """L1 is a sum over the pixels that count, divided by all pixels.

    SSIM is that of scikit-image over all pixels, for pictures that are equal under the mask.
    """
    image, target, mask = picture
    loss, l1, ssim = PhotometricLoss(0.2, threads=1)(replace_ignored(image, target, mask), target)
    truth, counts = target.numpy() / 255.0, mask.numpy()[..., 0]
    wanted_l1 = np.abs(image.numpy() - truth)[counts].sum() / image.numel()
    shown = np.where(mask.numpy(), image.numpy(), truth)
    wanted_ssim = ssim_map(shown, truth, beyond=5).mean()
    assert float(l1) == pytest.approx(wanted_l1, abs=1e-6)
    assert float(ssim) == pytest.approx(wanted_ssim, abs=1e-5)
    assert float(loss) == pytest.approx(0.8 * wanted_l1 + 0.2 * (1 - wanted_ssim), abs=1e-5)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_ignored_pixels_change_neither_the_loss_nor_its_gradient(picture, dtype):
    image, target, mask = picture
    results = []
    for noise in (0.0, 5.0):
        drawn = (image + noise * ~mask).to(dtype).requires_grad_()
        loss, *_ = PhotometricLoss(threads=1)(replace_ignored(drawn, target, mask), target)
        loss.backward()
        assert (drawn.grad[~mask.expand(-1, -1, 3)] == 0).all()
        results.append((loss.detach(), drawn.grad))
    assert torch.equal(results[0][0], results[1][0])
    assert torch.equal(results[0][1], results[1][1])


def test_densifiers_get_no_error_at_ignored_pixels(picture):
    from gsbench.gaussians.initial import gaussians_from_cloud

    _, target, mask = picture
    views = [View("a", CAMERA, target.numpy(), mask.numpy()[..., 0])]
    rng = np.random.default_rng(0)
    cloud = rng.normal(size=(40, 3)), rng.integers(0, 256, (40, 3), dtype=np.uint8)
    device = torch.device("cpu")
    gaussians = gaussians_from_cloud(*cloud, device)
    targets, background = Targets(views, device), torch.zeros(3)
    scene = SceneViews(
        views,
        targets,
        create_rasterizer("reference", device, 1),
        background,
        PhotometricLoss(threads=1),
        lambda step: 0,
    )
    image = scene.render(0, gaussians, 1).image
    error = (image - scene.image(0) / 255).abs().sum(-1)
    assert (error[~mask[..., 0]] == 0).all()
    assert (error[mask[..., 0]] > 0).any()
    inside = torch.nn.functional.max_pool2d(mask[None, None, ..., 0].float(), 11, 1, 5)[0, 0] == 0
    assert inside.any()
    assert (scene.dissimilarity(0, image)[inside] < 1e-6).all()
