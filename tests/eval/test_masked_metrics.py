"""Metrics over the pixels that count, against other programs and under irrelevant changes."""

import numpy as np
import pytest
import torch

from gsbench.eval.evaluator import Evaluator
from gsbench.eval.flip import flip_map
from gsbench.eval.lpips import load_lpips
from gsbench.eval.protocol import PAPER, STANDARD
from tests.eval.reference import ssim_map

HEIGHT, WIDTH = 64, 80


@pytest.fixture
def pair():
    rng = np.random.default_rng(0)
    truth = rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    render = np.clip(truth + rng.integers(-40, 41, truth.shape), 0, 255).astype(np.uint8)
    mask = np.ones((HEIGHT, WIDTH), dtype=bool)
    mask[10:40, 5:40] = False
    return render, truth, mask


def evaluator(protocol=STANDARD, shared=None, **options):
    weights = None if shared is None else shared / "weights"
    return Evaluator(
        protocol, lpips=["squeeze"] if shared else [], weights=weights, download=False, **options
    )


@pytest.mark.parametrize("protocol, beyond", [(STANDARD, 0), (PAPER, 5)])
def test_masked_ssim_is_the_mean_of_scikit_images_map_where_pixels_count(pair, protocol, beyond):
    render, truth, mask = pair
    full = ssim_map(np.where(mask[..., None], render, truth) / 255, truth / 255, beyond)
    counts = mask if beyond else mask[5:-5, 5:-5]
    found = evaluator(protocol).evaluate_view(render, truth, mask)["ssim"]
    assert found == pytest.approx(full[counts].mean(), abs=1e-9)


def test_pixels_under_the_mask_change_no_metric(pair, shared):
    render, truth, mask = pair
    noisy = np.where(mask[..., None], render, 255 - render)
    one, other = (evaluator(shared=shared).evaluate_view(x, truth, mask) for x in (render, noisy))
    assert one.keys() >= {"psnr", "ssim", "lpips_squeeze", "flip"}
    assert one == other
    assert one != evaluator(shared=shared).evaluate_view(render, truth)


def test_masked_flip_is_the_mean_of_its_map_where_pixels_count(pair):
    render, truth, mask = pair
    images = (
        torch.from_numpy(x / np.float32(255))
        for x in (np.where(mask[..., None], render, truth), truth)
    )
    wanted = flip_map(*images)[torch.from_numpy(mask)].double().mean()
    found = evaluator().evaluate_view(render, truth, mask)["flip"]
    assert found == pytest.approx(float(wanted), abs=1e-6)


def test_masked_lpips_is_the_distance_of_the_part_that_counts(shared):
    """The mask chooses one of two pictures side by side."""
    rng = np.random.default_rng(3)
    network = load_lpips("squeeze", shared / "weights", download=False)
    left, right = torch.rand(2, 1, 3, 256, 256, generator=torch.Generator().manual_seed(1)) * 2 - 1
    other = (left + torch.from_numpy(rng.normal(0, 0.4, left.shape)).float()).clamp(-1, 1)
    first, second = torch.cat([left, right], -1), torch.cat([other, right], -1)
    alone = float(network(left, other))
    for chosen, wanted in (
        ((slice(None), slice(0, 256)), alone),
        ((slice(None), slice(256, 512)), 0.0),
    ):
        mask = torch.zeros(256, 512, dtype=torch.bool)
        mask[chosen] = True
        assert float(network(first, second, mask)) == pytest.approx(wanted, abs=0.03 * alone)


def test_ssim_of_a_view_without_a_counted_window_is_unavailable(pair):
    render, truth, mask = pair
    mask = np.zeros_like(mask)
    mask[:3] = True  # no window fits into the image there
    judge = evaluator(STANDARD)
    values = judge.evaluate_view(render, truth, mask)
    assert "ssim" not in values
    assert "psnr" in values
    assert "ssim" in judge.unavailable


def test_a_users_metric_gets_the_mask_if_it_has_measure_masked(pair):
    render, truth, mask = pair

    class Plain:
        direction = -1

        def measure(self, image, truth):
            return float((image - truth).abs().mean())

    class Masked(Plain):
        def measure_masked(self, image, truth, mask):
            assert torch.equal(image[mask], torch.from_numpy(render)[mask] / 255)
            return float((image - truth).abs()[mask].mean())

    found = evaluator(extra={"plain": Plain(), "masked": Masked()}).evaluate_view(
        render, truth, mask
    )
    assert found["plain"] == pytest.approx(found["masked"] * mask.mean(), rel=1e-5)
