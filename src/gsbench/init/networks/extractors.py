"""Extractors of local features and matchers, built by name with their weights."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from gsbench.errors import InputError
from gsbench.init.networks.features import Features, FeatureSettings
from gsbench.scene.images import read_image
from gsbench.scene.options import downscaled_size
from gsbench.system.install import install_command
from gsbench.weights import MissingWeightsError, load_state

GPU_MEMORY_HINT = "lower init.max_image_size or init.max_keypoints, or set init.device=cpu"
SUPERPOINT_BORDER = 4  # px without keypoints, as in deep-image-matching
LIGHTGLUE_DETECTOR_PREFIX = "keypoint_detector."  # of SuperPoint's tensors in a LightGlue checkpoint of transformers


class Extractor(Protocol):
    """Finds features in an image [1, 3, H, W], RGB in [0, 1].

    Returns keypoints [K, 2] in px with the centre of the first pixel at (0, 0), descriptors [K, D] and scores [K].
    """

    def __call__(self, image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]: ...


def build_extractor(settings: FeatureSettings, weights: Path | None, device: torch.device) -> Extractor:
    """The extractor with its network on ``device``; ``weights`` is the checked file, or None if it needs none.

    Raises ``MissingWeightsError`` if the file does not fit the network.
    """
    return _BUILDERS[settings.extractor](settings, weights, device)


def extract_features(
    path: Path, extractor: Extractor, max_image_size: int, max_keypoints: int, device: torch.device
) -> Features:
    """The ``max_keypoints`` strongest features of an image file, shrunk to ``max_image_size`` px for the network.

    Raises ``InputError`` if the image cannot be read or the device runs out of memory.
    """
    pixels = read_image(path)  # [H, W, 3]
    height, width = pixels.shape[:2]
    network_size = downscaled_size(width, height, max_size=max_image_size)
    if network_size != (width, height):
        pixels = np.asarray(Image.fromarray(pixels).resize(network_size, Image.Resampling.LANCZOS))
    image = torch.from_numpy(pixels.astype(np.float32) / 255.0).permute(2, 0, 1)[None]  # [1, 3, h, w]
    try:
        with torch.inference_mode():
            keypoints, descriptors, scores = (part.float().cpu() for part in extractor(image.to(device)))
    except torch.OutOfMemoryError as error:
        size = f"{network_size[0]}x{network_size[1]}"
        raise InputError(f"{path.name}: {device} ran out of memory at {size} px: {GPU_MEMORY_HINT}") from error
    order = torch.sort(scores, descending=True, stable=True).indices[:max_keypoints]
    return Features(
        keypoints[order].numpy(), descriptors[order].numpy(), scores[order].numpy(), network_size, (width, height)
    )


def load_into(network: torch.nn.Module, state: Mapping[str, torch.Tensor], path: Path) -> None:
    """Load ``state`` into ``network``. It must hold every parameter in its shape; buffers may be absent."""
    try:
        missing, unexpected = network.load_state_dict(dict(state), strict=False)
    except RuntimeError as error:
        raise MissingWeightsError(
            f"weights file {path} has tensors of other shapes than the network: replace it"
        ) from error
    learned = {name for name, _ in network.named_parameters()}
    missing = sorted(learned.intersection(missing))
    if missing or unexpected:
        example = (missing or unexpected)[0]
        raise MissingWeightsError(
            f"weights file {path} is for another network ({len(missing)} tensors missing, {len(unexpected)} foreign, "
            f"for example {example}): replace it"
        )


def _superpoint(settings: FeatureSettings, weights: Path | None, device: torch.device) -> Extractor:
    try:
        from transformers import SuperPointConfig, SuperPointForKeypointDetection
    except ImportError as error:
        raise InputError(
            f"init.extractor=superpoint needs the package transformers: {install_command('dim')} "
            "(and pip uninstall torchvision where that cannot be imported)"
        ) from error

    assert weights is not None
    network = SuperPointForKeypointDetection(
        SuperPointConfig(
            keypoint_threshold=settings.keypoint_threshold,
            nms_radius=settings.nms_radius,
            max_keypoints=-1,
            border_removal_distance=0,
        )
    )
    state = load_state(weights)
    prefix = LIGHTGLUE_DETECTOR_PREFIX
    if any(name.startswith(prefix) for name in state):
        state = {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}
    load_into(network, state, weights)
    torch.nn.Module.to(network.eval(), device)

    def extract(image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        height, width = image.shape[-2:]
        output = network(_gray(image))  # reads the first channel only
        size = torch.tensor([width, height], device=image.device)
        # The output is relative to the size, and keypoints are whole px, so rounding restores them. The processor of
        # transformers truncates instead, and is one px too low in 5 % of the columns of some widths.
        keypoints = (output.keypoints[0] * size).round()  # [K, 2]
        # The network's own border removal is off, because it tests the right and bottom borders in the wrong unit.
        inside = ((keypoints >= SUPERPOINT_BORDER) & (keypoints < size - SUPERPOINT_BORDER)).all(dim=1)
        keep = inside & output.mask[0].bool()
        return keypoints[keep], output.descriptors[0][keep], output.scores[0][keep]

    return extract


def _aliked(settings: FeatureSettings, weights: Path | None, device: torch.device) -> Extractor:
    from kornia.feature import ALIKED

    assert weights is not None
    network = ALIKED(
        f"aliked-{settings.aliked_model}",
        max_num_keypoints=settings.max_keypoints,
        detection_threshold=settings.keypoint_threshold,
        nms_radius=settings.nms_radius,
    )
    load_into(network, load_state(weights), weights)
    network.to(device).eval()

    def extract(image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        features = network(image)[0]
        return features.keypoints, features.descriptors, features.keypoint_scores

    return extract


def _disk(settings: FeatureSettings, weights: Path | None, device: torch.device) -> Extractor:
    from kornia.feature import DISK

    assert weights is not None
    network = DISK()
    load_into(network, load_state(weights, entry="extractor"), weights)
    network.to(device).eval()

    def extract(image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        features = network(
            image,
            n=settings.max_keypoints,
            window_size=2 * settings.nms_radius + 1,
            score_threshold=settings.keypoint_threshold,
            pad_if_not_divisible=True,
        )[0]
        return features.keypoints, features.descriptors, features.detection_scores

    return extract


def _sift_kornia(settings: FeatureSettings, weights: Path | None, device: torch.device) -> Extractor:
    from kornia.feature import SIFTFeatureScaleSpace, laf_is_filled

    network = SIFTFeatureScaleSpace(settings.max_keypoints, device=device, descriptor_backend="pyramid").eval()

    def extract(image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        frames, responses, descriptors = network(_gray(image)[:, :1])
        filled = laf_is_filled(frames)[0]  # [K]: slots stay empty in an image with few extrema
        return frames[0, filled, :, 2], descriptors[0, filled], responses[0, filled]

    return extract


def _gray(image: torch.Tensor) -> torch.Tensor:
    """The luma of ITU-R BT.601 in three equal channels [1, 3, H, W]."""
    weights = image.new_tensor([0.299, 0.587, 0.114])[None, :, None, None]
    return (image * weights).sum(dim=1, keepdim=True).expand(-1, 3, -1, -1)


_BUILDERS: dict[str, Callable[[FeatureSettings, Path | None, torch.device], Extractor]] = {
    "superpoint": _superpoint,
    "aliked": _aliked,
    "disk": _disk,
    "sift_kornia": _sift_kornia,
}


class Matcher(Protocol):
    """Matches two images: indices [M, 2] of keypoints in the first and the second."""

    def __call__(self, first: Features, second: Features) -> NDArray[np.uint32]: ...


def build_matcher(settings: FeatureSettings, weights: Path | None, device: torch.device) -> Matcher:
    """The matcher named in ``settings``; ``weights`` is LightGlue's checked file.

    Raises ``MissingWeightsError`` if the file does not fit the network.
    """
    if settings.matcher == "mutual_nearest":
        return MutualNearestMatcher(settings.max_ratio, device)
    assert weights is not None
    return LightGlueMatcher(settings.extractor, settings.filter_threshold, weights, device)


@dataclass(frozen=True)
class MutualNearestMatcher:
    """Matches descriptors that are each other's nearest neighbour and pass the ratio test in both directions."""

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
    """kornia's LightGlue, with weights for the features of one extractor."""

    def __init__(self, extractor: str, filter_threshold: float, weights: Path, device: torch.device) -> None:
        from kornia.feature import LightGlue

        # Without a name of features, kornia does not download weights.
        no_name: Any = None
        layout = {key: value for key, value in LightGlue.features[extractor].items() if key != "weights"}
        self.network = LightGlue(no_name, filter_threshold=filter_threshold, **layout)
        state = load_state(weights)
        # The published files name a layer "self_attn.0", kornia's network "transformers.0.self_attn".
        for layer in range(self.network.conf.n_layers):
            for kind in ("self_attn", "cross_attn"):
                old, new = f"{kind}.{layer}.", f"transformers.{layer}.{kind}."
                state = {
                    name.replace(old, new) if name.startswith(old) else name: tensor for name, tensor in state.items()
                }
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
    """The matches [M, 2] of two images; raises ``InputError`` if the device runs out of memory."""
    if len(first.keypoints) == 0 or len(second.keypoints) == 0:
        return np.empty((0, 2), dtype=np.uint32)
    try:
        return matcher(first, second)
    except torch.OutOfMemoryError as error:
        count = max(len(first.keypoints), len(second.keypoints))
        raise InputError(f"matching of {count} keypoints ran out of memory: {GPU_MEMORY_HINT}") from error
