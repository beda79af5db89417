"""Networks of `gsbench.init.dim`: local features, extractors and matchers by name, and a store.

The store has one file for each image and each pair, so that an interrupted run continues from
there. The name of its folder is a hash of everything that the files depend on: the photographs, the
masks, the settings and the weights.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsbench.errors import InputError
from gsbench.files import DAMAGE, atomic, file_sha256
from gsbench.runs.configuration import sha256_of
from gsbench.scene.images import read_image, resize_image
from gsbench.scene.options import downscaled_size
from gsbench.scene.types import Capture, Mask
from gsbench.system.install import install_command
from gsbench.weights import load_into, load_state

Size = NDArray[np.int64] | tuple[int, int]


@dataclass(frozen=True, eq=False)
class Features:
    """Features of one image, strongest first.

    ``keypoints`` [K, 2] float32 are in px of the image at the network's size, with the centre of
    the first pixel at (0, 0). `colmap_keypoints` are in px of the file. ``descriptors`` are [K, D]
    float32, ``scores`` [K] float32.
    """

    keypoints: NDArray[np.float32]
    descriptors: NDArray[np.float32]
    scores: NDArray[np.float32]
    network_size: Size  # width, height in px
    file_size: Size

    @property
    def colmap_keypoints(self) -> NDArray[np.float32]:
        """Keypoints [K, 2] in px of the file, in COLMAP's convention.

        The centre of the first pixel is (0.5, 0.5).
        """
        scale = np.array(self.file_size, dtype=np.float64) / self.network_size
        return ((self.keypoints.astype(np.float64) + 0.5) * scale).astype(np.float32)

    def within(self, mask: Mask) -> Features:
        """The features on pixels that count in ``mask`` [H, W], which has the file's size."""
        height, width = mask.shape
        columns, rows = np.floor(self.colmap_keypoints).astype(np.int64).T  # [K] each
        kept = mask[rows.clip(0, height - 1), columns.clip(0, width - 1)]
        return Features(
            self.keypoints[kept],
            self.descriptors[kept],
            self.scores[kept],
            self.network_size,
            self.file_size,
        )


FORMAT_VERSION = 2  # to be raised when the same settings give different files
Matches = NDArray[np.uint32]  # indices [M, 2] of keypoints in the first and the second image


def store_folder(work: Path, capture: Capture, names: Sequence[str], *settings: object) -> Path:
    """The folder below ``work`` for features and matches of the images ``names``."""
    hashes = [
        [file_sha256(file) for file in (capture.images / name, capture.masks.get(name)) if file]
        for name in names
    ]
    return work / "features" / sha256_of([FORMAT_VERSION, list(names), hashes, *settings])


class FeatureStore:
    """Store of features and matches in ``folder`` (`store_folder`), a file each.

    What is missing or damaged is computed by ``extract`` and ``match``; features of up to ``room``
    images are kept in memory.
    """

    def __init__(
        self,
        folder: Path,
        extract: Callable[[str], Features],
        match: Callable[[Features, Features], Matches],
        room: int,
    ) -> None:
        self.folder, self._extract, self._match = folder, extract, match
        folder.mkdir(parents=True, exist_ok=True)
        self.features = lru_cache(room)(self._features)

    def path(self, *names: str) -> Path:
        """The file of an image, or of a pair of images."""
        return self.folder / f"{hashlib.sha256(repr(names).encode()).hexdigest()}.npz"

    def _features(self, name: str) -> Features:
        """The features of an image."""
        return Features(**self._stored(lambda: vars(self._extract(name)), name))

    def matches(self, *pair: str) -> Matches:
        """The matches of a pair of images."""
        found = self._stored(lambda: {"found": self._match(*map(self.features, pair))}, *pair)
        return found["found"]

    def _stored(self, make: Callable[[], Mapping[str, Any]], *names: str) -> Mapping[str, Any]:
        """The arrays in the file of ``names``, which ``make`` returns if it cannot be read."""
        path = self.path(*names)
        with suppress(*DAMAGE), np.load(path, allow_pickle=False) as data:
            return dict(data)
        made = make()
        with atomic(path, sync=False) as temporary, temporary.open("wb") as file:
            np.savez(file, **made)
        return made


# ---- extractors and matchers

GPU_MEMORY_HINT = "lower init.max_image_size or init.max_keypoints, or set init.device=cpu"
SUPERPOINT_BORDER = 4  # px without keypoints, as in deep-image-matching
# in the names of SuperPoint's tensors in a LightGlue checkpoint of transformers
LIGHTGLUE_DETECTOR_PREFIX = "keypoint_detector."

# Finds features in an image [1, 3, H, W], RGB in [0, 1]: keypoints [K, 2] in px with the centre of
# the first pixel at (0, 0), descriptors [K, D] and scores [K].
Found = tuple[Tensor, Tensor, Tensor]
Settings = Mapping[str, Any]  # `Dim.extraction`
Extractor = Callable[[Tensor], Found]


def extract_features(
    path: Path, extractor: Extractor, settings: Settings, device: torch.device
) -> Features:
    """Shrink an image to the ``max_image_size`` of ``settings`` and find its strongest features.

    Raises ``InputError`` if the image cannot be read or the device runs out of memory.
    """
    pixels = read_image(path)  # [H, W, 3]
    height, width = pixels.shape[:2]
    network_size = downscaled_size(width, height, max_size=settings["max_image_size"])
    pixels = resize_image(pixels, *network_size)
    image = torch.from_numpy(pixels.astype(np.float32) / 255.0).permute(2, 0, 1)[None]
    try:
        with torch.inference_mode():
            found = [part.float().cpu() for part in extractor(image.to(device))]
    except torch.OutOfMemoryError as error:
        size = f"{network_size[0]}x{network_size[1]}"
        raise InputError(
            f"{path.name}: {device} ran out of memory at {size} px: {GPU_MEMORY_HINT}"
        ) from error
    order = torch.sort(found[2], descending=True, stable=True).indices[: settings["max_keypoints"]]
    keypoints, descriptors, scores = (part[order].numpy() for part in found)
    return Features(keypoints, descriptors, scores, network_size, (width, height))


def _superpoint(settings: Settings, weights: Path, device: torch.device) -> Extractor:
    try:
        from transformers import SuperPointConfig, SuperPointForKeypointDetection
    except ImportError as error:
        raise InputError(
            f"init.extractor=superpoint needs the package transformers: {install_command('dim')} "
            "(and pip uninstall torchvision where that cannot be imported)"
        ) from error

    network = SuperPointForKeypointDetection(
        SuperPointConfig(
            keypoint_threshold=settings["keypoint_threshold"],
            nms_radius=settings["nms_radius"],
            max_keypoints=-1,
            border_removal_distance=0,
        )
    )
    state = load_state(weights)
    detector = {
        name.removeprefix(LIGHTGLUE_DETECTOR_PREFIX): value
        for name, value in state.items()
        if name.startswith(LIGHTGLUE_DETECTOR_PREFIX)
    }
    load_into(network, detector or state, weights).to(device)

    def extract(image: Tensor) -> Found:
        height, width = image.shape[-2:]
        output = network(_gray(image))  # reads the first channel only
        size = torch.tensor([width, height], device=image.device)
        # The output is relative to the size, and keypoints are whole px, so rounding restores them.
        # The processor of transformers truncates instead, and is one px too low in 5 % of the
        # columns of some widths.
        keypoints = (output.keypoints[0] * size).round()  # [K, 2]
        # The network's own border removal is off, because it tests the right and bottom borders in
        # the wrong unit.
        inside = (keypoints >= SUPERPOINT_BORDER) & (keypoints < size - SUPERPOINT_BORDER)
        keep = inside.all(dim=1) & output.mask[0].bool()
        return keypoints[keep], output.descriptors[0][keep], output.scores[0][keep]

    return extract


def _aliked(settings: Settings, weights: Path, device: torch.device) -> Extractor:
    from kornia.feature import ALIKED

    network = ALIKED(
        "aliked-n16",
        max_num_keypoints=settings["max_keypoints"],
        detection_threshold=settings["keypoint_threshold"],
        nms_radius=settings["nms_radius"],
    )
    load_into(network, load_state(weights), weights).to(device)

    def extract(image: Tensor) -> Found:
        features = network(image)[0]
        return features.keypoints, features.descriptors, features.keypoint_scores

    return extract


def _disk(settings: Settings, weights: Path, device: torch.device) -> Extractor:
    from kornia.feature import DISK

    network = DISK()
    load_into(network, load_state(weights, entry="extractor"), weights).to(device)

    def extract(image: Tensor) -> Found:
        features = network(
            image,
            n=settings["max_keypoints"],
            window_size=2 * settings["nms_radius"] + 1,
            score_threshold=settings["keypoint_threshold"],
            pad_if_not_divisible=True,
        )[0]
        return features.keypoints, features.descriptors, features.detection_scores

    return extract


def _gray(image: Tensor) -> Tensor:
    """The luma of ITU-R BT.601 in three equal channels [1, 3, H, W]."""
    weights = image.new_tensor([0.299, 0.587, 0.114])[None, :, None, None]
    return (image * weights).sum(dim=1, keepdim=True).expand(-1, 3, -1, -1)


# Each makes an extractor with its network on a device from the checked file of weights. They raise
# ``MissingWeightsError`` if the file does not fit the network.
EXTRACTORS: dict[str, Callable[[Settings, Path, torch.device], Extractor]] = {
    "superpoint": _superpoint,
    "aliked": _aliked,
    "disk": _disk,
}


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
        # DISK's file also has a constant 1 for each layer, which no code reads.
        state.pop(f"log_assignment.{layer}.r", None)
    load_into(network, state, weights).to(device)

    def inputs(features: Features) -> dict[str, torch.Tensor]:
        return {
            "keypoints": torch.from_numpy(features.keypoints)[None].to(device),  # [1, K, 2]
            "descriptors": torch.from_numpy(features.descriptors)[None].to(device),  # [1, K, D]
            "image_size": torch.tensor(
                np.array([features.network_size]), dtype=torch.float32, device=device
            ),  # [1, 2]
        }

    def match_features(first: Features, second: Features) -> Matches:
        with torch.inference_mode():
            result = network({"image0": inputs(first), "image1": inputs(second)})
        return result["matches"][0].cpu().numpy().astype(np.uint32).reshape(-1, 2)

    return match_features


def build_matcher(
    extraction: Settings, matching: Settings, weights: Path, device: torch.device
) -> Matcher:
    """The matcher of `Dim.matching`; ``weights`` is LightGlue's checked file, if it needs one.

    Raises ``MissingWeightsError`` if the file does not fit the network.
    """
    if matching["matcher"] == "mutual_nearest":
        return mutual_nearest_matcher(matching["max_ratio"], device)
    return lightglue_matcher(extraction["extractor"], matching["filter_threshold"], weights, device)


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
