"""The photometric loss compared with scikit-image, float64 autograd, and itself on more threads."""

import sys
from functools import partial
from types import SimpleNamespace

import pytest
import torch

from gsbench.train import loss as loss_module
from gsbench.train.loss import PhotometricLoss, photometric_loss, torch_photometric_loss
from gsbench.train.loss_cpu import CompiledLoss

SIZES = [(3, 4), (11, 16), (37, 53), (64, 65), (100, 21)]


def check_loss(loss, image, target, weight):
    """Compare a loss and its gradient with float64 for targets of both types; return the values."""
    found = []
    for wanted in (target, target / 255):
        leaf, precise = image.clone().requires_grad_(), image.double().requires_grad_()
        values = loss(leaf, wanted)
        expected = torch_photometric_loss(precise, target.double() / 255, weight)
        for value, reference in zip(values, expected, strict=True):
            assert value.item() == pytest.approx(reference.item(), abs=2e-6)
        (3 * values[0]).backward()
        (3 * expected[0]).backward()
        assert (leaf.grad - precise.grad).abs().max() < 1e-4 * precise.grad.abs().max()
        found.append(values)
    return found


def check_equal_images(loss, image):
    """Equal images have no loss and no gradient."""
    leaf = image.clone().requires_grad_()
    value, l1, similarity = loss(leaf, image)
    assert l1 == 0
    assert similarity.item() == pytest.approx(1, abs=1e-6)
    value.backward()
    assert leaf.grad.abs().max() < 1e-6  # L1's gradient at 0 is 0, SSIM is at its maximum


def images(height, width):
    """A smooth image with noise and, as target, the smooth image in 8 bits."""
    generator = torch.Generator().manual_seed(height)
    y, x = torch.meshgrid(torch.arange(height) / 9, torch.arange(width) / 7, indexing="ij")
    smooth = torch.stack([x.sin(), y.cos(), (x + y).sin()], -1) * 0.3 + 0.5
    image = (smooth + 0.1 * torch.randn(height, width, 3, generator=generator)).clamp(0, 1.2)
    return image, (smooth.clamp(0, 1) * 255).to(torch.uint8)


def test_kernels_are_used_for_float32_on_a_cpu_and_torch_otherwise():
    loss, (image, target) = PhotometricLoss(0.3, threads=1), images(12, 13)
    expected, _, _ = loss(image.double(), target)
    assert not loss._compiled
    assert float(loss(image, target)[0]) == pytest.approx(float(expected), rel=1e-5)
    assert isinstance(loss._compiled["cpu"], CompiledLoss)
    assert loss(image.to("meta"), target.to("meta"))[0].device.type == "meta"
    assert loss._compiled["meta"](image.double(), target)[0] == expected


def test_tritons_loss_is_taken_where_triton_runs(monkeypatch):
    stand_in = SimpleNamespace(TritonLoss=lambda weight: lambda *images: (weight, *images))
    monkeypatch.setitem(sys.modules, "gsbench.train.loss_triton", stand_in)
    obstacles = {"meta": None, "mps": "runs on device=cuda"}
    monkeypatch.setattr(
        loss_module, "find_executor", lambda name: SimpleNamespace(obstacle=obstacles.get)
    )
    image = torch.zeros(4, 5, 3, device="meta")
    weight, *images = PhotometricLoss(0.3)(image, image)
    assert weight == 0.3
    assert images == [image, image]
    assert PhotometricLoss(0.3)._compile("mps").func is torch_photometric_loss


@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.parametrize("weight", [0.2, 0.0, 1.0])
def test_the_compiled_loss_matches_float64(size, weight):
    check_loss(partial(photometric_loss, ssim_weight=weight), *images(*size), weight)


def test_equal_images_have_no_loss_and_no_gradient():
    check_equal_images(photometric_loss, images(20, 33)[0])


def test_a_term_may_be_added_to_the_loss_in_place():
    image = torch.rand(20, 20, 3, requires_grad=True)
    loss, *_ = photometric_loss(image, torch.rand(20, 20, 3))
    loss += image.mean()
    loss.backward()
    assert image.grad is not None


def test_any_number_of_threads_gives_the_same_bits():
    image, target = images(64, 65)
    results = []
    for threads in (1, 1, 2, 4):
        loss = PhotometricLoss(threads=threads)
        for _ in range(2):
            leaf = image.clone().requires_grad_()
            value = loss(leaf, target)[0]
            value.backward()
            results.append((value.item(), leaf.grad.numpy().tobytes()))
    assert len(set(results)) == 1


def test_the_loss_is_equal_without_gradient_in_float64_and_for_strided_images():
    image, target = images(16, 18)
    loss = PhotometricLoss(threads=1)
    with torch.no_grad():
        value = loss(image, target)[0]
    assert not value.requires_grad
    assert loss(image.double(), target)[0].item() == pytest.approx(value.item(), abs=1e-6)
    assert loss(image.transpose(0, 1).contiguous().transpose(0, 1), target)[0] == value


def test_inputs_that_do_not_fit_are_refused():
    image, target = images(16, 18)
    with pytest.raises(ValueError, match="shape"):
        photometric_loss(image, target[:-1])
    for wrong in (image[..., :2], image[0], image[None]):
        with pytest.raises(ValueError, match=r"must have one shape: \[H, W, 3\]"):
            photometric_loss(wrong, wrong)
    for weight in (1.01, -0.01):
        with pytest.raises(ValueError, match="ssim_weight"):
            photometric_loss(image, target, weight)
