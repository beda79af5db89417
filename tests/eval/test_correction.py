"""Metrics after a fit of colours: held against numpy's own least squares, and against pictures with a known tint."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsbench.errors import InputError
from gsbench.eval.evaluator import Evaluator
from gsbench.eval.geometry import band_errors
from gsbench.eval.images import fit_colors
from gsbench.eval.options import EvalConfig
from gsbench.eval.protocol import AFFINE, AFFINE_HALF, PROTOCOLS
from gsbench.scene.camera import Camera

RNG = np.random.default_rng(0)
PHOTOGRAPH = RNG.uniform(0.3, 0.7, (20, 24, 3)).astype(np.float32)
NOISY = np.clip(PHOTOGRAPH + RNG.normal(0, 0.02, PHOTOGRAPH.shape), 0, 1).astype(np.float32)
SLOPE, OFFSET = np.float32([0.8, 1.1, 0.9]), np.float32([0.05, -0.1, 0.0])


def fitted(image: np.ndarray, where: np.ndarray | None = None) -> np.ndarray:
    everywhere = np.ones(image.shape[:2], dtype=bool) if where is None else where
    return fit_colors(torch.from_numpy(image), torch.from_numpy(PHOTOGRAPH), torch.from_numpy(everywhere)).numpy()


def test_a_tint_is_taken_back() -> None:
    np.testing.assert_allclose(fitted(PHOTOGRAPH * SLOPE + OFFSET), PHOTOGRAPH, atol=1e-6)


def test_the_fit_is_that_of_numpy_by_channel() -> None:
    where = RNG.uniform(size=PHOTOGRAPH.shape[:2]) < 0.5
    for channel in range(3):
        slope, offset = np.polyfit(PHOTOGRAPH[where][:, channel], NOISY[where][:, channel], 1)
        expected = ((NOISY[..., channel] - offset) / slope).clip(0, 1)
        np.testing.assert_allclose(fitted(NOISY, where)[..., channel], expected, atol=1e-5)


def test_a_flat_or_inverted_render_is_moved_to_the_mean_alone() -> None:
    flat = np.full_like(PHOTOGRAPH, 0.25)
    np.testing.assert_allclose(fitted(flat), np.broadcast_to(PHOTOGRAPH.mean((0, 1)), flat.shape), atol=1e-6)
    assert np.corrcoef(fitted(1 - PHOTOGRAPH).ravel(), PHOTOGRAPH.ravel())[0, 1] < 0


def test_raw_metrics_stand_beside_those_after_the_fit_and_the_gain_is_their_difference() -> None:
    raw = Evaluator(PROTOCOLS["standard"], lpips=(), flip=False).evaluate_view(NOISY * SLOPE, PHOTOGRAPH)
    values = Evaluator(AFFINE, lpips=(), flip=False).evaluate_view(NOISY * SLOPE, PHOTOGRAPH)
    assert {key: values[key] for key in raw} == raw
    assert values["cc_gain"] == values["cc_psnr"] - values["psnr"] > 5
    assert values["cc_ssim"] > values["ssim"]


def test_one_half_is_fitted_and_the_other_measured() -> None:
    render = PHOTOGRAPH * SLOPE
    evaluator = Evaluator(AFFINE_HALF, lpips=(), flip=False)
    whole = evaluator.evaluate_view(render, PHOTOGRAPH)
    assert whole["cc_psnr"] > 50
    other = render.copy()
    other[:, 12:] = 0.5  # what is measured has no say in the fit
    assert evaluator.evaluate_view(other, PHOTOGRAPH)["cc_psnr"] < 25
    noise = render.copy()
    noise[:, :12] = 0.5 + 0.0 * noise[:, :12]  # a flat half says nothing of contrast: the mean alone is moved
    assert evaluator.evaluate_view(noise, PHOTOGRAPH)["psnr"] == whole["psnr"]


def test_ignored_pixels_have_no_say() -> None:
    mask = np.ones(PHOTOGRAPH.shape[:2], dtype=bool)
    mask[:5] = False
    render = PHOTOGRAPH * SLOPE
    evaluator = Evaluator(AFFINE, lpips=(), flip=False)
    expected = evaluator.evaluate_view(render, PHOTOGRAPH, mask)
    render[:5] = 0.9
    assert evaluator.evaluate_view(render, PHOTOGRAPH, mask) == expected


def test_a_declaration_needs_what_measures_it() -> None:
    EvalConfig(name="x", protocol="affine", primary="cc_psnr")
    with pytest.raises(InputError, match="eval=affine or eval=affine_half"):
        EvalConfig(name="x", protocol="paper", primary="cc_psnr")
    EvalConfig(name="x", protocol="paper", primary="error_far", bands=True)
    with pytest.raises(InputError, match=r"add eval\.bands=true"):
        EvalConfig(name="x", protocol="paper", primary="error_far")
    EvalConfig(name="x", protocol="paper", primary="fps", fps=[640, 480])
    with pytest.raises(InputError, match=r"add eval\.fps=\[1920,1080\]"):
        EvalConfig(name="x", protocol="paper", primary="fps")
    with pytest.raises(InputError, match=r"eval\.fps must be two sides in px"):
        EvalConfig(name="x", protocol="paper", fps=[640])


def test_bands_are_thirds_of_the_pixels_by_the_depth_of_the_points_there() -> None:
    camera = Camera(6, 2, 3.0, 3.0, 3.0, 1.0, np.eye(3), np.zeros(3))
    depths = np.array([9.0, 9.0, 1.0, 1.0, 4.0, 4.0])  # of the six columns
    points = np.array(
        [[(x + 0.5 - 3) / 3 * z, (y + 0.5 - 1) / 3 * z, z] for y in range(2) for x, z in enumerate(depths)]
    )
    truth = np.zeros((2, 6, 3))
    image = truth + np.array([7.0, 9.0, 1.0, 1.0, 2.0, 4.0])[None, :, None]
    everything = np.ones((2, 6), dtype=bool)
    assert band_errors(image, truth, camera, points, everything) == [1.0, 3.0, 8.0]
    assert np.isnan(band_errors(image, truth, camera, points - [0, 0, 20], everything)).all()
