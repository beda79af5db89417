"""The conventions of the protocols, each in a case that can be calculated by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from gsbench.errors import TrainingError
from gsbench.eval import evaluator as evaluator_module
from gsbench.eval import facts
from gsbench.eval.evaluator import Evaluator, quantize, summarize
from gsbench.eval.facts import find_metric
from gsbench.eval.lpips import load_lpips
from gsbench.eval.protocol import PAPER, STANDARD, get_protocol
from tests.helpers import refusal

pytestmark = pytest.mark.usefixtures("no_weights")
VGG = ("lpips_vgg", "lpips_vgg_raw")


def test_identifiers_are_named_and_versioned():
    assert (PAPER.id, STANDARD.id) == ("paper-1", "standard-1")
    assert get_protocol("paper") is PAPER
    with refusal("paper, standard"):
        get_protocol("papre")


def test_quantize_rounds_half_up_and_clamps():
    image = torch.tensor(
        [-0.1, 0.0, 0.499 / 255, 0.5 / 255, 1.49 / 255, 0.5, 254.6 / 255, 1.0, 1.7]
    )
    assert quantize(image).tolist() == [0, 0, 0, 1, 1, 128, 255, 255, 255]


def test_the_paper_compares_eight_bit_images():
    # 0.5 becomes 128/255 and 0.3 becomes 77/255 (76.5 + 0.5): the PSNR is that of the rounded pair.
    render = torch.full((12, 12, 3), 0.5)
    truth = np.full((12, 12, 3), 77, dtype=np.uint8)
    value = Evaluator(PAPER, lpips=[], flip=False).evaluate_view(render, truth)["psnr"]
    assert value == pytest.approx(-20 * math.log10((128 - 77) / 255), abs=1e-4)


def test_identical_images_get_the_documented_cap():
    image = np.full((16, 16, 3), 9, dtype=np.uint8)
    values = Evaluator(PAPER, lpips=[]).evaluate_view(image, image)
    assert values == {"psnr": 100.0, "ssim": pytest.approx(1.0), "flip": 0.0}


def test_missing_weights_are_named_and_not_replaced_by_another_network():
    evaluator = Evaluator(PAPER, lpips=["vgg_raw", "vgg"], download=False)
    image = np.zeros((32, 32, 3), dtype=np.uint8)
    assert set(evaluator.evaluate_view(image, image)) == {"psnr", "ssim", "flip"}
    others = {"lpips_alex", "lpips_squeeze"}  # not asked for
    assert evaluator.awaited == evaluator.unavailable.keys() - others == {*VGG}
    assert "vgg16-397923af.pth" in evaluator.unavailable["lpips_vgg_raw"]
    assert "not asked for" in evaluator.unavailable["lpips_alex"]
    assert not any("\n" in reason for reason in evaluator.unavailable.values())


@pytest.mark.shared
def test_raw_lpips_variants_get_values_from_0_to_1_and_others_from_minus_1_to_1(
    shared, monkeypatch
):
    squeeze = find_metric("lpips_squeeze")
    raw = replace(squeeze, key="lpips_squeeze_raw")
    monkeypatch.setattr(facts, "METRICS", (squeeze, raw))
    monkeypatch.setattr(evaluator_module, "METRICS", (squeeze, raw))
    evaluator = Evaluator(
        PAPER, lpips=["squeeze", "squeeze_raw"], flip=False, weights=shared / "weights"
    )
    render, truth = np.random.default_rng(0).integers(0, 256, (2, 40, 40, 3), dtype=np.uint8)
    values = evaluator.evaluate_view(render, truth)
    first, second = (torch.tensor(x).permute(2, 0, 1)[None].float() / 255 for x in (render, truth))
    network = load_lpips("squeeze", shared / "weights")
    assert values["lpips_squeeze"] == pytest.approx(float(network(first * 2 - 1, second * 2 - 1)))
    assert values["lpips_squeeze_raw"] == pytest.approx(float(network(first, second)))
    assert values["lpips_squeeze"] != pytest.approx(values["lpips_squeeze_raw"], rel=0.01)


@pytest.mark.shared
def test_lpips_of_too_small_a_view_is_unavailable(shared):
    evaluator = Evaluator(
        PAPER, lpips=["squeeze"], flip=False, weights=shared / "weights", download=False
    )
    image = np.zeros((16, 40, 3), dtype=np.uint8)
    assert "lpips_squeeze" not in evaluator.evaluate_view(image, image)
    assert evaluator.unavailable["lpips_squeeze"] == "a view is 40x16 px, below 17 px a side"


def test_a_render_with_nan_is_refused():
    render = torch.full((16, 16, 3), float("nan"))
    with pytest.raises(TrainingError, match="not finite"):
        Evaluator(PAPER, lpips=[]).evaluate_view(render, np.zeros((16, 16, 3), dtype=np.uint8))


@pytest.mark.parametrize(
    "choice, known",
    [
        ({"lpips": ["vgg16"]}, "vgg_raw, vgg, alex, squeeze"),
        ({"more": ["psnr"]}, "ms_ssim, iw_ssim"),
    ],
)
def test_unknown_metrics_are_refused(choice, known):
    with refusal(f"choose among {known}"):
        Evaluator(PAPER, **choice)


def test_means_leave_out_metrics_that_a_view_lacks():
    """A metric of a region has the mean over the views that show it."""
    per_view = {"a": {"psnr": 20.0, "flip": 0.1, "psnr@far": 10.0}, "b": {"psnr": 30.0}}
    assert summarize(per_view, {}) == {"psnr": 25.0, "psnr@far": 10.0}
    assert summarize(per_view, {"psnr": "broken"}) == {}
    assert summarize({}, {}) == {}
