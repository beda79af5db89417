"""DISTS (Ding, Ma, Wang and Simoncelli 2020, "Image quality assessment: unifying structure and texture similarity").

VGG16's feature maps, and the image itself, are compared by their means (texture) and their covariance (structure),
each channel with its learned weights alpha and beta. A texture that is drawn anew elsewhere costs little.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gsbench.errors import InputError
from gsbench.eval.lpips import BACKBONES, find_any, load_features
from gsbench.weights import WeightsFile, find_weights, load_state

MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet's photographs, for which VGG16 is trained
STABILITY = 1e-6  # c1 and c2 of eq. 5 and 6, as the authors' code has them
ROOT_EPSILON = 1e-12  # below the root of the pooling, ibid.
VGG = BACKBONES["vgg"]
CHANNELS = (3, *VGG.channels)  # of the image and of relu1_2, relu2_2, relu3_3, relu4_3, relu5_3
SIDE = 256  # px that the shorter side is reduced to, where it is longer: the authors' images of learning and testing

ALPHA_BETA = WeightsFile(
    ("dists_alpha_beta.pt", "DISTS_pytorch/weights.pt"),
    "https://raw.githubusercontent.com/dingkeyan93/DISTS/master/DISTS_pytorch/weights.pt",
    "f5e65c96230b7f6ca995691647d482237e4cab8a50c5c4a5784f219ef0748218",
    licence="MIT",
    source="weights.pt of the package DISTS-pytorch 0.1 (PyPI)",
)


class HannPool(nn.Module):
    """Halves maps by the root of the weighted mean square of 3x3 px, with Hann's weights (1, 2, 1) (eq. 2)."""

    def forward(self, maps: Tensor) -> Tensor:
        """[B, C, H, W] to [B, C, ceil(H / 2), ceil(W / 2)]."""
        line = torch.tensor([0.25, 0.5, 0.25], device=maps.device, dtype=maps.dtype)
        kernel = torch.outer(line, line).expand(maps.shape[1], 1, 3, 3)  # [C, 1, 3, 3]
        pooled = F.conv2d(maps.square(), kernel, stride=2, padding=1, groups=maps.shape[1])
        return (pooled + ROOT_EPSILON).sqrt()


class Dists:
    """The network of DISTS, ready to compare images; it computes no gradients.

    ``features`` holds VGG16's weights as torchvision names them, ``weights`` the channels' ``alpha`` and ``beta``, each
    of 1,475 values. Raises InputError for those of another network.
    """

    def __init__(
        self, features: Mapping[str, Tensor], weights: Mapping[str, Tensor], device: torch.device | str = "cpu"
    ) -> None:
        stack = VGG.build()
        load_features(stack, features, "DISTS")
        layers = [HannPool() if isinstance(layer, nn.MaxPool2d) else layer for layer in stack]
        self._layers = nn.Sequential(*layers[: max(VGG.taps) + 1]).requires_grad_(False).eval().to(device)
        found = [weights.get(name) for name in ("alpha", "beta")]
        if any(one is None or one.numel() != sum(CHANNELS) for one in found):
            raise InputError(f"the weights of DISTS lack alpha and beta of {sum(CHANNELS)} values: not that network's")
        alpha, beta = (one.flatten().double().to(device) for one in found if one is not None)  # [1475] each
        total = alpha.sum() + beta.sum()
        self._alpha, self._beta = (alpha / total).split(CHANNELS), (beta / total).split(CHANNELS)
        self._mean = torch.tensor(MEAN, device=device).view(1, 3, 1, 1)
        self._deviation = torch.tensor(DEVIATION, device=device).view(1, 3, 1, 1)
        self.device = torch.device(device)

    @torch.no_grad()
    def __call__(self, image: Tensor, target: Tensor) -> Tensor:
        """The distance [] of two images [H, W, 3] in [0, 1]: 0 for identical ones, and the same in either order."""
        if image.shape != target.shape or image.ndim != 3 or image.shape[2] != 3:
            raise ValueError(f"DISTS compares images [H, W, 3], got {tuple(image.shape)} and {tuple(target.shape)}")
        first, second = (reduced(one.to(self.device, torch.float32)) for one in (image, target))  # [1, 3, h, w] each
        alike = self._alike(0, first, second)
        first, second = ((one - self._mean) / self._deviation for one in (first, second))
        stage = 1
        for index, layer in enumerate(self._layers):
            first, second = layer(first), layer(second)  # [1, C, h, w] each
            if index in VGG.taps:
                alike = alike + self._alike(stage, first, second)
                stage += 1
        return 1 - alike

    def _alike(self, stage: int, first: Tensor, second: Tensor) -> Tensor:
        """The part [] of one stage in the similarity, eq. 5 to 7; maps [1, C, h, w]."""
        x, y = first[0].flatten(1).double(), second[0].flatten(1).double()  # [C, h * w] each
        mean_x, mean_y = x.mean(dim=1), y.mean(dim=1)  # [C]
        texture = (2 * mean_x * mean_y + STABILITY) / (mean_x.square() + mean_y.square() + STABILITY)
        dx, dy = x - mean_x[:, None], y - mean_y[:, None]
        structure = (2 * (dx * dy).mean(dim=1) + STABILITY) / (
            dx.square().mean(dim=1) + dy.square().mean(dim=1) + STABILITY
        )
        return (self._alpha[stage] * texture + self._beta[stage] * structure).sum()


def reduced(image: Tensor) -> Tensor:
    """[H, W, 3] as [1, 3, h, w] whose shorter side is at most 256 px, filtered as Pillow's ``BILINEAR`` does."""
    batch = image.permute(2, 0, 1).unsqueeze(0)  # [1, 3, H, W]
    height, width = image.shape[:2]
    shorter = min(height, width)
    if shorter <= SIDE:
        return batch
    size = (SIDE * height // shorter, SIDE * width // shorter)
    return F.interpolate(batch, size, mode="bilinear", antialias=True, align_corners=False)


def load_dists(folder: Path | None = None, download: bool = True, device: torch.device | str = "cpu") -> Dists:
    """DISTS from weights in ``folder``, the usual places or a download; may raise ``MissingWeights``."""
    weights = find_weights(ALPHA_BETA, folder, download)
    features = find_any(VGG.features, folder, download)
    return Dists(load_state(features), load_state(weights), device)
