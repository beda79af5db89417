"""PSNR, SSIM and FLIP against other programs and values calculated by hand."""

import math
import re

import flip_evaluator
import numpy as np
import pytest
import torch

from gsbench.eval.evaluator import psnr
from gsbench.eval.flip import flip, flip_map
from gsbench.eval.ssim import ssim
from tests.eval.reference import ssim_map


def distorted_pair(height=40, width=53, seed=0):
    """A smooth image and a noisy copy, [H, W, 3] float64 in [0, 1]."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[0:height, 0:width]
    image = 0.5 + 0.4 * np.sin(rows[..., None] / 5 + columns[..., None] / 7 + rng.uniform(0, 6, 3))
    return image, np.clip(image + rng.normal(0, 0.08, image.shape), 0, 1)


def test_psnr_is_one_value_per_image_over_all_channels():
    # Channel errors of 0.1, 0.2 and 0 give mse (0.01 + 0.04) / 3; a mean of per-channel PSNRs would
    # be infinite.
    target = torch.zeros(2, 3, 4, 5, dtype=torch.float64)
    image = target.clone()
    image[0, 0], image[0, 1], image[1] = 0.1, 0.2, 1.0
    assert psnr(image, target).tolist() == pytest.approx(
        [-10 * math.log10(0.05 / 3), 0.0], abs=1e-9
    )


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("padding, beyond", [("valid", 0), ("zero", 5)])
def test_ssim_matches_scikit_image(seed, padding, beyond):
    x, y = distorted_pair(seed=seed)
    expected, other = (ssim_map(y, x, around).mean() for around in (beyond, 5 - beyond))
    x, y = torch.tensor(x), torch.tensor(y)
    assert float(ssim(y, x, padding)) == pytest.approx(expected, abs=1e-9)
    assert float(ssim(y.float(), x.float(), padding)) == pytest.approx(expected, abs=1e-5)
    assert abs(expected - other) > 1e-3  # the two conventions differ


def test_a_batch_gives_the_values_of_its_images():
    pairs = [distorted_pair(20, 24, seed) for seed in range(3)]
    first, second = (
        torch.tensor(np.stack([pair[k] for pair in pairs])).permute(0, 3, 1, 2) for k in (0, 1)
    )  # [3, 3, 20, 24]
    for metric in (psnr, ssim, flip):
        single = [float(metric(torch.tensor(y), torch.tensor(x))) for x, y in pairs]
        assert metric(second, first).tolist() == pytest.approx(single, abs=1e-7)


@pytest.mark.parametrize(
    "shape, other", [((4, 5, 3), (4, 6, 3)), ((3, 4, 5), (3, 4, 5)), ((2, 1, 4, 5), (2, 1, 4, 5))]
)
def test_wrong_shapes_and_types_are_refused(shape, other):
    for metric in (
        psnr,
        ssim,
        flip,
        flip_map,
        lambda x, y: ssim(x, y, mask=torch.ones(4, 5, dtype=torch.bool)),
    ):
        words = "image" if shape == other else f"{shape} and {other}"
        with pytest.raises(ValueError, match=re.escape(words)):
            metric(torch.zeros(shape), torch.zeros(other))
    with pytest.raises(ValueError, match="floating point"):
        psnr(*torch.zeros(2, 12, 12, 3, dtype=torch.uint8))
    with pytest.raises(ValueError, match="11 px"):
        ssim(*torch.zeros(2, 10, 30, 3), "valid")


def of_authors(image, target, ppd):
    """The map of the authors' program, [H, W], of arrays [H, W, 3]."""
    images = [np.ascontiguousarray(x, dtype=np.float32) for x in (target, image)]
    errors, _, _ = flip_evaluator.evaluate(
        *images, "LDR", applyMagma=False, parameters={"ppd": ppd}
    )
    return errors[..., 0]


def colors(height, width, seed):
    """Colours of the whole cube, in blocks with sharp edges, and a copy with other blocks."""
    rng = np.random.default_rng(seed)
    blocks = rng.integers(0, 5, (2, height // 8 + 1, width // 8 + 1, 3)) / 4
    image, other = blocks.repeat(8, axis=1).repeat(8, axis=2)[:, :height, :width]
    return image, np.where(rng.random((height, width, 1)) < 0.3, other, image)


@pytest.mark.parametrize("ppd", [8.0, 67.02, 150.0])
@pytest.mark.parametrize(
    "pair",
    [distorted_pair(), distorted_pair(64, 9, 1), colors(50, 71, 2), colors(1, 3, 3)],
    ids=["noise", "narrow", "colors", "tiny"],
)
def test_each_pixel_has_the_error_of_the_authors_program(pair, ppd):
    target, image = pair
    expected = of_authors(image, target, ppd)
    for dtype in (torch.float32, torch.float64):
        found = flip_map(torch.tensor(image, dtype=dtype), torch.tensor(target, dtype=dtype), ppd)
        # Powers below 1 enlarge what rounding leaves of differences near 0, in both programs.
        assert np.abs(found.numpy() - expected).max() < 2e-4
    assert float(flip(torch.tensor(image), torch.tensor(target), ppd)) == pytest.approx(
        expected.mean(dtype=np.float64), abs=2e-6
    )
