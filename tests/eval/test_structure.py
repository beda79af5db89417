"""MS-SSIM, IW-SSIM, FSIM and GMSD: what gsbench gives to piq, and what it says without piq."""

import sys

import numpy as np
import pytest
import torch
from scipy import ndimage
from skimage import data

from gsbench.eval.evaluator import Evaluator
from gsbench.eval.facts import METRICS, further_keys
from gsbench.eval.metric import UnavailableError
from gsbench.eval.more import STRUCTURAL, load_structural
from gsbench.eval.protocol import PAPER

# The values of an implementation after the authors' papers, without piq, in the order of STRUCTURAL.
# For MS-SSIM of odd sides piq differs by 0.0041: it pads at the start, the authors at the end.
VALUES = {
    ((176, 208), "noise"): (0.855058, 0.918725, 0.795234, 0.094648),
    ((176, 208), "blur"): (0.975246, 0.947219, 0.892403, 0.071217),
    ((176, 208), "colour"): (0.991429, 0.998934, 0.962509, 0.026642),
    ((201, 180), "noise"): (0.850891, 0.917124, 0.790511, 0.097128),
    ((384, 416), "noise"): (0.879034, 0.933156, 0.935056, 0.088751),
}


@pytest.fixture
def with_piq():
    try:
        load_structural("ms_ssim")
    except UnavailableError as error:
        pytest.skip(str(error))


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


@pytest.mark.parametrize("case", VALUES, ids=str)
def test_values_are_those_of_an_implementation_after_the_papers(case, with_piq):
    for key, expected in zip(STRUCTURAL, VALUES[case], strict=True):
        odd = key == "ms_ssim" and case[0][0] % 2
        found = load_structural(key)(*pair(*case[0], case[1]))
        assert found == pytest.approx(expected, abs=0.0045 if odd else 3e-5), key


@pytest.mark.parametrize("key", STRUCTURAL)
def test_identical_images_have_the_best_value_and_more_distortion_is_worse(key, with_piq):
    facts = next(facts for facts in METRICS if facts.key == key)
    measure, (image, truth) = load_structural(key), pair(176, 180)
    best = measure(truth, truth)
    values = [measure(truth + share * (image - truth), truth) for share in (0.25, 0.5, 1.0)]
    assert best == pytest.approx(facts.highest if facts.direction > 0 else facts.lowest, abs=1e-9)
    assert [best, *values] == sorted([best, *values], reverse=facts.direction > 0)
    assert all(facts.lowest <= value <= facts.highest for value in values)


@pytest.mark.parametrize("key", STRUCTURAL)
def test_views_that_are_too_small_are_unavailable(key, with_piq):
    smallest, rng = STRUCTURAL[key][1], np.random.default_rng(0)
    for side, there in ((smallest, True), (smallest - 1, False)):
        evaluator = Evaluator(PAPER, lpips=[], flip=False, more=[key])
        render, truth = rng.integers(0, 256, (2, side, 170, 3), dtype=np.uint8)
        assert (key in evaluator.evaluate_view(render, truth)) is there
        assert (key in evaluator.unavailable) is not there
    assert (
        evaluator.unavailable[key] == f"a view is 170x{smallest - 1} px, below {smallest} px a side"
    )
    assert key not in evaluator.awaited


def test_iw_ssim_of_flat_views_is_unavailable_with_a_reason(with_piq):
    evaluator = Evaluator(PAPER, lpips=[], flip=False, more=["iw_ssim"])
    flat = np.full((170, 170, 3), 90, dtype=np.uint8)
    assert "iw_ssim" not in evaluator.evaluate_view(flat, flat)
    assert evaluator.unavailable["iw_ssim"] == "a view is flat: it has no structure to compare"


@pytest.mark.parametrize("key", STRUCTURAL)
def test_without_piq_a_metric_is_unavailable_with_the_package_to_install(key, monkeypatch):
    monkeypatch.setitem(sys.modules, "piq", None)  # as if it were not installed
    evaluator = Evaluator(PAPER, lpips=[], flip=False, more=[key])
    assert "pip install 'gsbench-3dgs[piq]'" in evaluator.unavailable[key]
    assert evaluator.awaited == {key}  # measured again once piq is there
    image = np.zeros((170, 170, 3), dtype=np.uint8)
    assert evaluator.evaluate_view(image, image).keys() == {"psnr", "ssim"}


def test_further_metrics_that_are_not_requested_leave_no_trace():
    evaluator, image = Evaluator(PAPER, lpips=[], flip=False), np.zeros((9, 9, 3), np.uint8)
    assert set(STRUCTURAL) == set(further_keys())
    assert not {*evaluator.unavailable, *evaluator.evaluate_view(image, image)} & {*further_keys()}
