"""DISTS against piq's, against a restatement with numpy and scipy, and where its weights are looked for."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from scipy import ndimage, signal
from skimage import data
from torch import Tensor

from gsbench.errors import InputError
from gsbench.eval.dists import ALPHA_BETA, CHANNELS, Dists, load_dists, reduced
from gsbench.eval.evaluator import Evaluator
from gsbench.eval.lpips import BACKBONES
from gsbench.eval.protocol import PROTOCOLS
from gsbench.weights import MissingWeights
from tests.eval.test_lpips import State, random_weights


def fake_weights() -> tuple[State, State]:
    """VGG16's and the channels' weights of the right shapes; alpha and beta do not add up to 1."""
    generator = torch.Generator().manual_seed(1)
    features, _ = random_weights("vgg")
    own = {name: torch.rand(1, sum(CHANNELS), 1, 1, generator=generator) for name in ("alpha", "beta")}
    return features, own


@pytest.fixture(scope="module")
def network() -> Dists:
    return Dists(*fake_weights())


def pair(height: int, width: int) -> tuple[Tensor, Tensor]:
    """A blurred and noisy photograph, and the photograph, [H, W, 3] in [0, 1]."""
    truth = data.astronaut()[40 : 40 + height, 60 : 60 + width] / 255
    noise = np.random.default_rng(0).normal(0, 0.05, truth.shape)
    image = np.clip(ndimage.gaussian_filter(truth, (1.0, 1.0, 0)) + noise, 0, 1)
    return torch.tensor(image, dtype=torch.float32), torch.tensor(truth, dtype=torch.float32)


def restated(image: Tensor, target: Tensor) -> float:
    """The paper's equations in float64, layer by layer with scipy; images of at most 256 px."""
    features, own = fake_weights()
    w = {key.removeprefix("features."): value.double().numpy() for key, value in features.items()}
    hann = np.outer([1, 2, 1], [1, 2, 1]) / 16

    def stages(image: Tensor) -> list[np.ndarray]:
        x = image.permute(2, 0, 1).double().numpy()  # [3, H, W]
        found = [x]
        x = (x - np.array([0.485, 0.456, 0.406])[:, None, None]) / np.array([0.229, 0.224, 0.225])[:, None, None]
        for block in ([0, 2], [5, 7], [10, 12, 14], [17, 19, 21], [24, 26, 28]):
            if block[0] > 0:
                x = np.sqrt([signal.convolve2d(one**2, hann, "same")[::2, ::2] + 1e-12 for one in x])
            for index in block:
                kernels, biases = w[f"{index}.weight"], w[f"{index}.bias"]
                x = np.stack(
                    [
                        sum(signal.correlate2d(one, k, "same") for one, k in zip(x, kernel, strict=True)) + bias
                        for kernel, bias in zip(kernels, biases, strict=True)
                    ]
                ).clip(0)
            found.append(x)
        return found

    alpha, beta = (own[name].flatten().double().numpy() for name in ("alpha", "beta"))
    total, at, value = alpha.sum() + beta.sum(), 0, 1.0
    for x, y in zip(stages(image), stages(target), strict=True):
        for one, other in zip(x, y, strict=True):
            covariance = np.cov(one.ravel(), other.ravel(), bias=True)
            means = (2 * one.mean() * other.mean() + 1e-6) / (one.mean() ** 2 + other.mean() ** 2 + 1e-6)
            structure = (2 * covariance[0, 1] + 1e-6) / (covariance[0, 0] + covariance[1, 1] + 1e-6)
            value -= (alpha[at] * means + beta[at] * structure) / total
            at += 1
    return value


@pytest.mark.slow  # 1.6 million small correlations
def test_agrees_with_the_papers_equations(network: Dists) -> None:
    image, truth = pair(18, 21)
    assert float(network(image, truth)) == pytest.approx(restated(image, truth), abs=1e-5)


@pytest.mark.parametrize("size", [(64, 80), (51, 67), (256, 300)], ids=str)
def test_agrees_with_piq(size: tuple[int, int], network: Dists, monkeypatch: pytest.MonkeyPatch) -> None:
    """piq's own class, which wants torchvision for VGG16 and the net for the rest: both get the weights made up."""
    spec = importlib.util.find_spec("piq")
    if spec is None:
        pytest.skip("piq is not installed")
    features, own = fake_weights()
    stack = BACKBONES["vgg"].build()
    stack.load_state_dict({key.removeprefix("features."): value for key, value in features.items()})
    models = ModuleType("torchvision.models")
    for name in ("vgg16", "vgg19"):
        setattr(models, name, lambda **_: SimpleNamespace(features=stack))
    vision, package = ModuleType("torchvision"), ModuleType("piq")
    vision.models = models  # type: ignore[attr-defined]
    package.__path__ = list(spec.submodule_search_locations or [])  # the package as a whole wants more of torchvision
    for name, module in (("torchvision", vision), ("torchvision.models", models), ("piq", package)):
        monkeypatch.setitem(sys.modules, name, module)
    before = set(sys.modules)
    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", lambda *_, **__: scaled(own))
    try:
        peer = importlib.import_module("piq.perceptual").DISTS()
        image, truth = pair(*size)
        first, second = (x.permute(2, 0, 1).unsqueeze(0) for x in (image, truth))
        assert float(network(image, truth)) == pytest.approx(float(peer(first, second)), abs=2e-5)
    finally:
        for name in set(sys.modules) - before:
            if name.startswith("piq."):
                del sys.modules[name]


def scaled(own: State) -> State:
    """The channels' weights with a sum of 1, as piq keeps them."""
    total = sum(float(value.sum()) for value in own.values())
    return {name: value / total for name, value in own.items()}


def test_identical_images_have_distance_zero_and_order_does_not_matter(network: Dists) -> None:
    image, truth = pair(40, 48)
    assert float(network(truth, truth)) == pytest.approx(0, abs=1e-9)
    assert float(network(image, truth)) == pytest.approx(float(network(truth, image)), abs=1e-12) != 0


def test_large_images_are_reduced_as_pillow_does(network: Dists) -> None:
    _, truth = pair(400, 311)
    assert reduced(truth).shape == (1, 3, 329, 256)
    levels = Image.fromarray((truth.numpy() * 255).round().astype(np.uint8))
    pillow = np.asarray(levels.resize((256, 329), Image.Resampling.BILINEAR)) / 255
    assert np.abs(reduced(truth)[0].permute(1, 2, 0).numpy() - pillow).max() < 1.01 / 255
    assert reduced(truth[:256]).shape == (1, 3, 256, 311)


def test_weights_of_another_network_are_refused() -> None:
    features, own = fake_weights()
    for broken in ({}, {"alpha": own["alpha"]}, own | {"beta": own["beta"][:, 1:]}):
        with pytest.raises(InputError, match="alpha and beta of 1475 values"):
            Dists(features, broken)
    with pytest.raises(InputError, match="the weights of DISTS lack"):
        Dists(random_weights("alex")[0], own)


def save(folder: Path) -> None:
    features, own = fake_weights()
    torch.save(features, folder / "vgg16-397923af.pth")
    torch.save(own, folder / ALPHA_BETA.names[0])


def test_without_its_weights_it_is_not_computed_and_says_which_file_to_get(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "hub"))
    monkeypatch.delenv("GSBENCH_WEIGHTS", raising=False)
    with pytest.raises(MissingWeights, match=r"dists_alpha_beta\.pt"):
        load_dists(tmp_path, download=False)
    evaluator = Evaluator(PROTOCOLS["paper"], lpips=[], flip=False, weights=tmp_path, download=False, more=["dists"])
    assert "weights not found: dists_alpha_beta.pt" in evaluator.unavailable["dists"]
    assert "dists" in evaluator.awaited
    assert "dists" not in evaluator.evaluate_view(*pair(40, 48))
    save(tmp_path)  # of no checksum that is known
    evaluator = Evaluator(PROTOCOLS["paper"], lpips=[], flip=False, weights=tmp_path, download=False, more=["dists"])
    assert "has sha256" in evaluator.unavailable["dists"]


def test_with_its_weights_it_is_one_of_the_metrics(
    tmp_path: Path, network: Dists, monkeypatch: pytest.MonkeyPatch
) -> None:
    save(tmp_path)
    monkeypatch.setattr("gsbench.weights._checksum_fault", lambda *_: None)
    evaluator = Evaluator(PROTOCOLS["paper"], lpips=[], flip=False, weights=tmp_path, download=False, more=["dists"])
    image, truth = ((255 * x).round().to(torch.uint8) for x in pair(40, 48))
    expected = float(network(image.float() / 255, truth.float() / 255))
    assert evaluator.evaluate_view(image, truth)["dists"] == pytest.approx(expected, abs=1e-9)
