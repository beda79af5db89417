"""LPIPS v0.1 (Zhang et al. 2018).

The paper is "The unreasonable effectiveness of deep features as a perceptual metric". The layers of
VGG16, AlexNet and SqueezeNet 1.1 are in torchvision's order, so that torchvision's ImageNet weights
load into them without torchvision. The learned linear heads are those of LPIPS v0.1.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gsbench.errors import InputError
from gsbench.parsing import table_beside
from gsbench.weights import WeightsFile, find_weights, load_into, load_state

# The networks' input normalisation, per channel: (x - SHIFT) / SCALE for x in [-1, 1].
SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
NORM_EPSILON = 1e-10  # added to the length of a feature vector before dividing by it
ROWS_AT_A_TIME = 64  # feature rows compared at once, to limit the memory


POOLS = {
    "half": nn.MaxPool2d(2),
    "third": nn.MaxPool2d(3, 2),
    "ceiled": nn.MaxPool2d(3, 2, ceil_mode=True),
}
Layer = int | str | list[int]  # as backbones.yaml explains them


@dataclass(frozen=True)
class Backbone:
    """A network's convolutional layers, which of them LPIPS compares, and the weights files."""

    layers: list[Layer]
    taps: list[int]  # indices of the modules whose output is compared
    min_size: int  # px; with a shorter side, some layer has no output
    features: WeightsFile
    heads: WeightsFile

    def build(self) -> tuple[nn.Sequential, list[int]]:
        """The modules, without weights, and the channels of each tap."""
        modules: list[nn.Module] = []
        widths, channels = [], 3  # behind each module
        for layer in self.layers:
            added: list[nn.Module]
            match layer:
                case str():
                    added = [POOLS[layer]]
                case [squeezed, expanded]:
                    added = [Fire(channels, squeezed, expanded)]
                    channels = 2 * expanded
                case _:
                    plain = [layer, 3, 1, 1] if isinstance(layer, int) else layer
                    width, size, stride, padding = plain
                    convolution = nn.Conv2d(channels, width, size, stride, padding)
                    added, channels = [convolution, nn.ReLU(inplace=True)], width
            modules += added
            widths += [channels] * len(added)
        return nn.Sequential(*modules), [widths[tap] for tap in self.taps]


class Fire(nn.Module):
    """SqueezeNet's block: a 1x1 squeeze, then 1x1 and 3x3 expansions side by side."""

    def __init__(self, channels: int, squeezed: int, expanded: int) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(channels, squeezed, 1)
        self.expand1x1 = nn.Conv2d(squeezed, expanded, 1)
        self.expand3x3 = nn.Conv2d(squeezed, expanded, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        squeezed = self.squeeze(x).relu_()
        both = torch.cat([self.expand1x1(squeezed), self.expand3x3(squeezed)], dim=1)
        return both.relu_()  # [B, 2 * expanded, H, W]


TORCHVISION = "https://download.pytorch.org/models/"
AUTHORS = (
    "https://raw.githubusercontent.com/richzhang/PerceptualSimilarity/master/lpips/weights/v0.1/"
)


def _backbone(net: str, row: Mapping[str, Any]) -> Backbone:
    name, copy, heads = row["features"], row["copy"], f"{net}.pth"
    source, copies = f"{copy}, from {row['source']}", ((copy, row["copy_sha256"]),)
    return Backbone(
        row["layers"],
        row["taps"],
        row["min_size"],
        WeightsFile((name,), f"{TORCHVISION}{name}", row["sha256"], source, copies),
        WeightsFile((f"lpips_v0.1_{heads}", heads), f"{AUTHORS}{heads}", row["heads_sha256"]),
    )


BACKBONES = {
    net: _backbone(net, row) for net, row in table_beside(__file__, "backbones.yaml").items()
}


class Lpips:
    """One LPIPS network, ready to compare images; it computes no gradients.

    ``features`` holds the backbone's weights with the keys of torchvision's model, or of its
    ``features`` alone; keys of a classifier are ignored. ``heads`` holds ``lin{k}.model.1.weight``
    [1, C, 1, 1] for every tap k.
    """

    def __init__(
        self,
        net: str,
        features: Mapping[str, Tensor],
        heads: Mapping[str, Tensor],
        device: torch.device | str = "cpu",
    ) -> None:
        self.net, self.device = net, torch.device(device)
        self.backbone = BACKBONES[net]
        stack, widths = self.backbone.build()
        # published files also have a classifier
        own = {key.removeprefix("features."): value.float() for key, value in features.items()}
        own = {key: value for key, value in own.items() if key in stack.state_dict()}
        load_into(stack, own, f"of lpips {net}")
        self._layers = stack.to(device)
        self._heads = []  # [C] each
        for index, channels in enumerate(widths):
            weight = heads.get(f"lin{index}.model.1.weight")
            if weight is None or weight.numel() != channels:
                raise InputError(
                    f"the heads of lpips {net} lack lin{index} with {channels} weights: not that "
                    "network's heads"
                )
            self._heads.append(weight.flatten().float().to(device))
        self._shift, self._scale = (
            torch.tensor(values, device=device).view(1, 3, 1, 1) for values in (SHIFT, SCALE)
        )

    @torch.no_grad()
    def __call__(self, first: Tensor, second: Tensor, mask: Tensor | None = None) -> Tensor:
        """Distances [B] of two batches [B, 3, H, W], which are fed to the network unchanged.

        LPIPS is defined for inputs in [-1, 1]: pass ``2 * x - 1`` for images in [0, 1]. The
        evaluation of 3DGS passes images in [0, 1] unchanged, as the metrics named ``..._raw`` do.

        With a ``mask`` [H, W], each position of a layer is weighted by the share of its pixels that
        count.
        """
        if min(first.shape[-2:]) < self.backbone.min_size:
            raise ValueError(
                f"lpips {self.net} needs sides of at least {self.backbone.min_size} px"
            )
        # [1, 1, H, W]
        weights = None if mask is None else mask.to(self.device, torch.float32)[None, None]
        pairs = zip(first.split(1), second.split(1), strict=True)
        return torch.stack([self._pair(a, b, weights) for a, b in pairs])  # [B]

    def _pair(self, first: Tensor, second: Tensor, weights: Tensor | None) -> Tensor:
        """The distance [] of two images [1, 3, H, W]."""
        # Both images pass a layer before the next one, so that features of earlier layers need not
        # be kept.
        first, second = (
            (image.to(self.device, torch.float32) - self._shift) / self._scale
            for image in (first, second)
        )
        total = torch.zeros((), device=self.device)
        heads = iter(self._heads)
        for index, layer in enumerate(self._layers):
            first, second = layer(first), layer(second)  # [1, C, h, w] each
            if index in self.backbone.taps:
                size = first.shape[2], first.shape[3]
                own = None if weights is None else F.adaptive_avg_pool2d(weights, size)[0, 0]
                total = total + _feature_distance(first, second, next(heads), own)
        return total


def load_lpips(
    net: str, folder: Path | None = None, download: bool = True, device: torch.device | str = "cpu"
) -> Lpips:
    """Load an LPIPS network from ``folder`` or the usual places, else download its weights.

    Raises ``MissingWeightsError`` if they are not found.
    """
    backbone = BACKBONES[net]
    features = find_weights(backbone.features, folder, download)
    heads = find_weights(backbone.heads, folder, download)
    return Lpips(net, load_state(features), load_state(heads), device)


def _feature_distance(
    first: Tensor, second: Tensor, head: Tensor, weights: Tensor | None
) -> Tensor:
    """Spatial mean of the weighted squared difference of unit feature vectors.

    ``first`` and ``second`` are [1, C, h, w], ``head`` is [C]. ``weights`` [h, w] weight the
    positions in the mean; None weights them equally.
    """
    if weights is not None:
        first, second = (
            x / (x.square().sum(dim=1, keepdim=True).sqrt() + NORM_EPSILON) for x in (first, second)
        )
        distances = ((first - second).square()[0] * head[:, None, None]).sum(dim=0)  # [h, w]
        return (distances * weights).sum().double() / weights.sum().double()
    on_cpu = first.device.type == "cpu"
    total = first.new_zeros((), dtype=torch.float64 if on_cpu else torch.float32)
    rows = (x[0].split(ROWS_AT_A_TIME, dim=1) for x in (first, second))
    for a, b in zip(*rows, strict=True):
        a = a / (a.square().sum(dim=0).sqrt() + NORM_EPSILON)  # [C, rows, w]
        b = b / (b.square().sum(dim=0).sqrt() + NORM_EPSILON)  # [C, rows, w]
        per_channel = (a - b).square().sum(dim=(1, 2))  # [C]
        total = total + (per_channel * head).sum()
    return total / (first.shape[2] * first.shape[3])
