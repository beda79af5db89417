"""Matchers of two images' features, by name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsbench.errors import InputError
from gsbench.init.networks.extractors import GPU_MEMORY_HINT, load_into
from gsbench.init.networks.features import Features, FeatureSettings
from gsbench.weights import load_state

Matches = NDArray[np.uint32]  # indices [M, 2] of keypoints in the first and the second image
Matcher = Callable[[Features, Features], Matches]


def mutual_nearest_matcher(max_ratio: float, device: torch.device) -> Matcher:
    """A matcher of mutual nearest neighbours that pass the ratio test in both directions."""
    from kornia.feature import match_smnn

    def match_features(first: Features, second: Features) -> Matches:
        ours, theirs = (
            torch.from_numpy(features.descriptors).to(device) for features in (first, second)
        )  # [K, D]
        with torch.inference_mode():
            _, indices = match_smnn(ours, theirs, max_ratio)
        return indices.cpu().numpy().astype(np.uint32).reshape(-1, 2)

    return match_features


def lightglue_matcher(
    extractor: str, filter_threshold: float, weights: Path, device: torch.device
) -> Matcher:
    """kornia's LightGlue, with weights for the features of one extractor."""
    from kornia.feature import LightGlue

    # kornia downloads weights unless the name of the features is None.
    no_name: Any = None
    layout = dict(LightGlue.features[extractor])
    layout.pop("weights", None)
    network = LightGlue(no_name, filter_threshold=filter_threshold, **layout)
    state = load_state(weights)
    # The published files name a layer "self_attn.0", kornia's network "transformers.0.self_attn".
    for layer in range(network.conf.n_layers):
        for kind in ("self_attn", "cross_attn"):
            old, new = f"{kind}.{layer}.", f"transformers.{layer}.{kind}."
            for name in [name for name in state if name.startswith(old)]:
                state[name.replace(old, new)] = state.pop(name)
    # DISK's file also has a constant 1 for each layer, "log_assignment.0.r", that no code reads.
    unread = [f"log_assignment.{layer}.r" for layer in range(network.conf.n_layers)]
    state = {name: value for name, value in state.items() if name not in unread}
    load_into(network, state, weights, device)

    def inputs(features: Features) -> dict[str, torch.Tensor]:
        return {
            "keypoints": torch.from_numpy(features.keypoints)[None].to(device),  # [1, K, 2]
            "descriptors": torch.from_numpy(features.descriptors)[None].to(device),  # [1, K, D]
            "image_size": torch.tensor(
                [features.network_size], dtype=torch.float32, device=device
            ),  # [1, 2]
        }

    def match_features(first: Features, second: Features) -> Matches:
        with torch.inference_mode():
            result = network({"image0": inputs(first), "image1": inputs(second)})
        return result["matches"][0].cpu().numpy().astype(np.uint32).reshape(-1, 2)

    return match_features


def build_matcher(settings: FeatureSettings, weights: Path | None, device: torch.device) -> Matcher:
    """The matcher named in ``settings``; ``weights`` is LightGlue's checked file.

    Raises ``MissingWeightsError`` if the file does not fit the network.
    """
    if settings.matcher == "mutual_nearest":
        return mutual_nearest_matcher(settings.max_ratio, device)
    assert weights is not None
    return lightglue_matcher(settings.extractor, settings.filter_threshold, weights, device)


def match(matcher: Matcher, first: Features, second: Features) -> Matches:
    """The matches [M, 2] of two images; raises ``InputError`` if the device runs out of memory."""
    if len(first.keypoints) == 0 or len(second.keypoints) == 0:
        return np.empty((0, 2), dtype=np.uint32)
    try:
        return matcher(first, second)
    except torch.OutOfMemoryError as error:
        count = max(len(first.keypoints), len(second.keypoints))
        raise InputError(
            f"matching of {count} keypoints ran out of memory: {GPU_MEMORY_HINT}"
        ) from error
