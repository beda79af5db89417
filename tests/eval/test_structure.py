"""MS-SSIM, IW-SSIM, FSIM and GMSD against piq, independent versions and values by hand."""

import numpy as np
import pytest
import torch
from scipy import ndimage
from skimage import data
from skimage.metrics import structural_similarity
from torch.testing import assert_close

from gsbench.eval.evaluator import Evaluator
from gsbench.eval.facts import METRICS, further_keys
from gsbench.eval.metrics import gmsd
from gsbench.eval.protocol import PAPER
from gsbench.eval.structure import (
    MULTISCALE_MIN_SIZE,
    SCALE_WEIGHTS,
    _enlarged,
    _frequencies,
    fsim,
    iw_ssim,
    ms_ssim,
    phase_congruency,
)
from tests.helpers import refusal

FUNCTIONS = {"ms_ssim": ms_ssim, "iw_ssim": iw_ssim, "fsim": fsim, "gmsd": gmsd}
ODD = (201, 180)  # px, height and width
# The values of piq 0.8.0 for the pairs below, in the order of FUNCTIONS
PIQ = {
    ((176, 208), "noise"): (0.855058, 0.918725, 0.795243, 0.094648),
    ((176, 208), "blur"): (0.975246, 0.947219, 0.892405, 0.071217),
    ((176, 208), "colour"): (0.991429, 0.998934, 0.962485, 0.026642),
    (ODD, "noise"): (0.846831, 0.917124, 0.790528, 0.097128),
    (ODD, "blur"): (0.97566, 0.945774, 0.888644, 0.070438),
    (ODD, "colour"): (0.991679, 0.998897, 0.961885, 0.025274),
    ((384, 416), "noise"): (0.879034, 0.933155, 0.935063, 0.088751),
}


def pair(height, width, distortion="noise"):
    """A distorted photograph and the photograph, [H, W, 3] float64 in [0, 1]."""
    truth = data.astronaut()[40 : 40 + height, 60 : 60 + width] / 255
    if distortion == "blur":
        image = ndimage.gaussian_filter(truth, (1.5, 1.5, 0))
    elif distortion == "colour":
        image = np.clip(truth * [0.8, 1.0, 1.1] + 0.05, 0, 1)
    else:
        image = np.clip(truth + np.random.default_rng(0).normal(0, 0.08, truth.shape), 0, 1)
    return torch.tensor(image), torch.tensor(truth)


@pytest.mark.parametrize("case", PIQ, ids=str)
def test_structural_metrics_agree_with_piq(case):
    image, truth = pair(*case[0], case[1])
    for key, expected in zip(FUNCTIONS, PIQ[case], strict=True):
        if key == "ms_ssim" and case[0] == ODD:
            # piq pads odd sides at their start; a test below follows the authors
            continue
        assert float(FUNCTIONS[key](image, truth)) == pytest.approx(expected, abs=1e-4), key


@pytest.mark.parametrize("size", [(161, 170), (187, 161), (192, 192)], ids=str)
def test_ms_ssim_halves_images_as_its_authors_do(size):
    """Their ``imfilter(image, ones(2) / 4, 'symmetric')`` and every other pixel, with scipy.

    SSIM is scikit-image's; contrast times structure is SSIM divided by luminance.
    """
    image, truth = (x.numpy() for x in pair(*size))
    products = []
    for channel in range(3):
        x, y, product = image[..., channel], truth[..., channel], 1.0
        for scale, weight in enumerate(SCALE_WEIGHTS):
            options = {"gaussian_weights": True, "sigma": 1.5, "data_range": 1.0}
            options["use_sample_covariance"] = False
            full = structural_similarity(x, y, full=True, **options)[1]
            mean_x, mean_y = (
                ndimage.gaussian_filter(z, 1.5, truncate=3.5, mode="reflect") for z in (x, y)
            )
            luminance = (2 * mean_x * mean_y + 1e-4) / (mean_x**2 + mean_y**2 + 1e-4)
            compared = full if scale == 4 else full / luminance
            product *= compared[5:-5, 5:-5].mean() ** weight
            x, y = (
                ndimage.correlate(z, np.full((2, 2), 0.25), mode="reflect", origin=-1)[::2, ::2]
                for z in (x, y)
            )
        products.append(product)
    assert float(ms_ssim(*map(torch.tensor, (image, truth)))) == pytest.approx(
        np.mean(products), abs=1e-7
    )


def test_a_coarser_band_is_enlarged_as_by_the_authors_of_iw_ssim():
    """By hand: their ``imresize`` makes 0, 0.4, 2, 3.6, 4 of a line 0, 4.

    Extrapolated by one on each side, every other number is kept.
    """
    line = torch.tensor([-0.4, 0.4, 3.6, 4.4], dtype=torch.float64)
    band = torch.tensor([[0.0, 4.0], [40.0, 44.0]], dtype=torch.float64)
    assert_close(_enlarged(band[None, None])[0, 0], line + 10 * line[:, None])


def test_gmsd_of_a_square_equals_the_value_by_hand():
    """A grey square against black; the similarity at a gradient m is c / (m² + c).

    Zeros pad the images, so both have black borders, which make no edge.
    """
    truth = torch.zeros(12, 12, 3, dtype=torch.float64)
    image = truth.clone()
    image[4:8, 4:8] = 0.5  # 2x2 px of 0.5 in 6x6 px after halving
    plane = np.zeros((6, 6))
    plane[2:4, 2:4] = 0.5
    across = ndimage.correlate(plane, np.array([[-1, 0, 1]] * 3) / 3, mode="constant")
    down = ndimage.correlate(plane, np.array([[-1, 0, 1]] * 3).T / 3, mode="constant")
    constant = 170 / 255**2
    expected = np.std(constant / (across**2 + down**2 + constant))
    assert float(gmsd(image, truth)) == pytest.approx(expected, abs=1e-12)


def test_phase_congruency_does_not_depend_on_contrast():
    """An edge of any height has the same value, and noise has a low one (Kovesi 1999)."""
    rows = torch.zeros(128, 128, dtype=torch.float64)
    rows[64:] = 1.0
    rows += 0.02 * torch.randn(
        rows.shape, generator=torch.Generator().manual_seed(0), dtype=rows.dtype
    )
    low, high = (phase_congruency((40 + step * rows)[None, None])[0, 0] for step in (20.0, 200.0))
    assert torch.allclose(low, high, atol=1e-3)
    assert high[63:65].mean() > 0.5 > 5 * high[28:36].mean()


@pytest.mark.parametrize("key", FUNCTIONS)
def test_identical_images_have_the_best_value_and_more_distortion_is_worse(key):
    facts = next(facts for facts in METRICS if facts.key == key)
    image, truth = pair(176, 180)
    best = float(FUNCTIONS[key](truth, truth))
    values = [
        float(FUNCTIONS[key](truth + share * (image - truth), truth)) for share in (0.25, 0.5, 1.0)
    ]
    assert best == pytest.approx(facts.highest if facts.direction > 0 else facts.lowest, abs=1e-9)
    assert [best, *values] == sorted([best, *values], reverse=facts.direction > 0)
    assert all(facts.lowest <= value <= facts.highest for value in values)


@pytest.mark.parametrize("key", FUNCTIONS)
def test_a_batch_gives_the_values_of_its_images(key):
    pairs = [pair(176, 180, distortion) for distortion in ("noise", "blur")]
    first, second = (torch.stack([one[k] for one in pairs]).permute(0, 3, 1, 2) for k in (0, 1))
    single = [float(FUNCTIONS[key](*one)) for one in pairs]
    assert FUNCTIONS[key](first, second).tolist() == pytest.approx(single, abs=1e-9)


@pytest.mark.parametrize(
    "key, smallest", [("ms_ssim", 161), ("iw_ssim", 161), ("fsim", 16), ("gmsd", 2)]
)
def test_too_small_images_are_refused_and_reported_as_unavailable(key, smallest):
    assert MULTISCALE_MIN_SIZE == 161
    with pytest.raises(ValueError, match=f"at least {smallest} px"):
        FUNCTIONS[key](torch.rand(smallest - 1, 300, 3), torch.rand(smallest - 1, 300, 3))
    rng = np.random.default_rng(0)
    for side, there in ((smallest, True), (smallest - 1, False)):
        evaluator = Evaluator(PAPER, lpips=[], flip=False, more=[key])
        render, truth = rng.integers(0, 256, (2, max(side, 1), 170, 3), dtype=np.uint8)
        assert (key in evaluator.evaluate_view(render, truth)) is there
        assert (key in evaluator.unavailable) is not there
    assert (
        evaluator.unavailable[key] == f"a view is 170x{smallest - 1} px, below {smallest} px a side"
    )
    assert key not in evaluator.awaited


@pytest.mark.parametrize("key", ["iw_ssim", "fsim"])
def test_metrics_of_flat_views_are_unavailable_with_a_reason(key):
    evaluator = Evaluator(PAPER, lpips=[], flip=False, more=[key])
    flat = np.full((170, 170, 3), 90, dtype=np.uint8)
    assert key not in evaluator.evaluate_view(flat, flat)
    assert evaluator.unavailable[key] == "a view is flat: it has no structure to compare"


def test_partly_flat_views_are_measured():
    """For example, black borders of undistorted photographs and renders of one colour."""
    image, truth = pair(176, 180)
    image[:90], truth[:90] = 0, 0
    for function in FUNCTIONS.values():
        assert 0 < float(function(image, truth)) < 1
        assert np.isfinite(float(function(torch.full_like(truth, 0.5), truth)))


def test_further_metrics_that_are_not_requested_leave_no_trace():
    evaluator, image = Evaluator(PAPER, lpips=[], flip=False), np.zeros((9, 9, 3), np.uint8)
    assert set(FUNCTIONS) < set(further_keys())
    assert not {*evaluator.unavailable, *evaluator.evaluate_view(image, image)} & {*further_keys()}


def test_an_unknown_metric_is_refused():
    with refusal("choose among ms_ssim, iw_ssim, fsim, gmsd"):
        Evaluator(PAPER, more=["psnr"])


@pytest.mark.parametrize("key", FUNCTIONS)
def test_images_of_different_sizes_are_refused(key):
    with pytest.raises(ValueError, match=r"different shapes: \(192, 192, 3\) and \(192, 193, 3\)"):
        FUNCTIONS[key](torch.zeros(192, 192, 3), torch.zeros(192, 193, 3))


@pytest.mark.parametrize(
    "size, expected",
    [
        (4, [0, 0.25, -0.5, -0.25]),
        # Kovesi's filters have both ends at half a cycle per pixel
        (5, [0, 0.25, 0.5, -0.5, -0.25]),
    ],
)
def test_frequencies_of_filters_reach_half_a_cycle_per_pixel(size, expected):
    assert _frequencies(size, torch.zeros(1)).tolist() == expected
