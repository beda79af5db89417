"""Matchers of local features, by descriptors alone or by a network."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from gsbench.errors import InputError
from gsbench.init.networks.extractors import GPU_MEMORY_MEND, load_into
from gsbench.init.networks.features import Features, FeatureSettings
from gsbench.weights import load_state


class Matcher(Protocol):
    """Matches two images: indices [M, 2] of keypoints in the first and the second."""

    def __call__(self, first: Features, second: Features) -> NDArray[np.uint32]: ...


def build_matcher(settings: FeatureSettings, weights: Path | None, device: torch.device) -> Matcher:
    """The matcher named in ``settings``; ``weights`` is LightGlue's checked file.

    Raises ``MissingWeights`` where the file does not fit the network.
    """
    if settings.matcher == "mutual_nearest":
        return MutualNearest(settings.max_ratio, device)
    assert weights is not None
    return LightGlueMatcher(settings.extractor, settings.filter_threshold, weights, device)


@dataclass(frozen=True)
class MutualNearest:
    """Descriptors that are each other's nearest and pass the ratio test both ways."""

    max_ratio: float
    device: torch.device

    def __call__(self, first: Features, second: Features) -> NDArray[np.uint32]:
        from kornia.feature import match_smnn

        first_descriptors = torch.from_numpy(first.descriptors).to(self.device)  # [K, D]
        second_descriptors = torch.from_numpy(second.descriptors).to(self.device)
        with torch.inference_mode():
            _, indices = match_smnn(first_descriptors, second_descriptors, self.max_ratio)
        return indices.cpu().numpy().astype(np.uint32).reshape(-1, 2)


class LightGlueMatcher:
    """kornia's LightGlue with weights for the features of one extractor."""

    def __init__(self, extractor: str, filter_threshold: float, weights: Path, device: torch.device) -> None:
        from kornia.feature import LightGlue

        unnamed: Any = None  # a named one would download its weights
        layout = {key: value for key, value in LightGlue.features[extractor].items() if key != "weights"}
        self.network = LightGlue(unnamed, filter_threshold=filter_threshold, **layout)
        state = load_state(weights)
        for layer in range(self.network.conf.n_layers):  # the published files name the layers by their kind first
            for kind in ("self_attn", "cross_attn"):
                old, new = f"{kind}.{layer}.", f"transformers.{layer}.{kind}."
                state = {name.replace(old, new) if name.startswith(old) else name: v for name, v in state.items()}
        load_into(self.network, state, weights)
        self.network.to(device).eval()
        self.device = device

    def __call__(self, first: Features, second: Features) -> NDArray[np.uint32]:
        with torch.inference_mode():
            result = self.network({"image0": self._input(first), "image1": self._input(second)})
        return result["matches"][0].cpu().numpy().astype(np.uint32).reshape(-1, 2)

    def _input(self, features: Features) -> dict[str, torch.Tensor]:
        return {
            "keypoints": torch.from_numpy(features.keypoints)[None].to(self.device),  # [1, K, 2]
            "descriptors": torch.from_numpy(features.descriptors)[None].to(self.device),  # [1, K, D]
            "image_size": torch.tensor([features.network_size], dtype=torch.float32, device=self.device),  # [1, 2]
        }


def match(matcher: Matcher, first: Features, second: Features) -> NDArray[np.uint32]:
    """Matches [M, 2]; raises ``InputError`` where the device runs out of memory."""
    if len(first.keypoints) == 0 or len(second.keypoints) == 0:
        return np.empty((0, 2), dtype=np.uint32)
    try:
        return matcher(first, second)
    except torch.OutOfMemoryError as error:
        count = max(len(first.keypoints), len(second.keypoints))
        raise InputError(f"matching of {count} keypoints ran out of memory: {GPU_MEMORY_MEND}") from error
