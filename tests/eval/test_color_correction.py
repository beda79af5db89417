"""The example of a metric after a correction of colours, against numpy's least squares."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from gsbench.eval.evaluator import Evaluator
from gsbench.eval.protocol import PAPER
from tests.conftest import script

corrected_of = script("corrected", "examples")

RANDOM = np.random.default_rng(0)
TRUTH = RANDOM.uniform(0.2, 0.8, (24, 30, 3))
MATRIX = np.array([[0.8, 0.1, 0.0], [0.05, 0.7, 0.1], [-0.1, 0.0, 0.9]])
OFFSET = np.array([0.02, 0.05, 0.1])


def corrected(image, truth, mask=None):
    counted = np.ones(image.shape[:2], bool) if mask is None else mask
    return corrected_of.color_corrected(*map(torch.from_numpy, (image, truth, counted))).numpy()


def by_numpy(image, truth):
    """The definition with numpy's solver, with a set of pixels for each channel."""
    found, goal = image.reshape(-1, 3), truth.reshape(-1, 3)
    low, high = 0.5 / 255, 1 - 0.5 / 255
    for _ in range(5):
        inside = ((found > low) & (found < high)).all(axis=1)
        columns = []
        for channel in range(3):
            used = inside & (goal[:, channel] > low) & (goal[:, channel] < high)
            matrix = np.column_stack([found, np.ones(len(found))])
            row, *_ = np.linalg.lstsq(matrix[used], goal[used, channel], rcond=None)
            columns.append(matrix @ row)
        found = np.clip(np.column_stack(columns), 0, 1)
    return found.reshape(image.shape)


def test_the_correction_equals_least_squares_of_numpy_with_clipped_pixels():
    truth = RANDOM.uniform(0, 1, (24, 30, 3))
    truth[:3] = 1.0
    noisy = np.clip(1.6 * truth @ MATRIX.T + RANDOM.normal(0, 0.05, truth.shape), 0, 1)
    result = corrected(noisy, truth)
    assert_allclose(result, by_numpy(noisy, truth), atol=1e-9)
    assert np.abs(result - truth)[3:].mean() < 0.5 * np.abs(noisy - truth)[3:].mean()


def test_pixels_that_a_mask_ignores_do_not_count():
    changed = TRUTH @ MATRIX.T + OFFSET
    mask = np.ones(TRUTH.shape[:2], dtype=bool)
    mask[:8] = False
    changed[:8] = 0.5
    assert_allclose(corrected(changed, TRUTH, mask)[8:], TRUTH[8:], atol=1e-9)


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_the_correction_of_a_render_of_one_colour_is_finite(value):
    result = corrected(np.full_like(TRUTH, value), TRUTH)
    assert np.isfinite(result).all()
    if value == 0.5:  # the best single colour is the mean
        assert_allclose(result, np.broadcast_to(TRUTH.mean(axis=(0, 1)), TRUTH.shape), atol=1e-9)
    else:  # all pixels are clipped, so the map is unknown
        assert_array_equal(result, value)


def test_the_metric_is_that_of_the_corrected_render():
    metric = corrected_of.CorrectedPsnr()
    photograph = (TRUTH * 255 + 0.5).astype(np.uint8)
    evaluator = Evaluator(PAPER, lpips=[], flip=False, extra={"psnr_cc": metric})
    values = evaluator.evaluate_view((TRUTH * 0.6 * 255 + 0.5).astype(np.uint8), photograph)
    assert values["psnr_cc"] > values["psnr"] + 20
    assert evaluator.evaluate_view(photograph, photograph)["psnr_cc"] == 100
