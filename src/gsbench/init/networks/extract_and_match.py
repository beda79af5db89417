"""The networks' part of deep image matching: the features of all images and the matches of all
pairs.

Extractors and matchers are built by name with their weights.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsbench.errors import InputError
from gsbench.files import file_sha256
from gsbench.init.base import Preparation, Timer
from gsbench.init.colmap.pairs import STRONGEST, proposed_pairs
from gsbench.init.colmap.reconstruct import load_reference, select_pairs
from gsbench.init.networks.features import Features, FeatureSettings, FeatureStore
from gsbench.logs import Progress
from gsbench.scene.images import read_image, read_mask, resize_image
from gsbench.scene.options import downscaled_size
from gsbench.scene.types import Capture
from gsbench.system.device import select_device
from gsbench.system.install import install_command
from gsbench.weights import MissingWeightsError, load_state
from gsbench.words import some_of

if TYPE_CHECKING:
    from gsbench.init.dim import FeatureInitializer

GPU_MEMORY_HINT = "lower init.max_image_size or init.max_keypoints, or set init.device=cpu"
SUPERPOINT_BORDER = 4  # px without keypoints, as in deep-image-matching
# of SuperPoint's tensors in a LightGlue checkpoint of transformers
LIGHTGLUE_DETECTOR_PREFIX = "keypoint_detector."


# Finds features in an image [1, 3, H, W], RGB in [0, 1]: keypoints [K, 2] in px with the centre of
# the first pixel at (0, 0), descriptors [K, D] and scores [K].
Extractor = Callable[[torch.Tensor], tuple[torch.Tensor, torch.Tensor, torch.Tensor]]
# Matches two images: indices [M, 2] of keypoints in the first and the second.
Matcher = Callable[[Features, Features], NDArray[np.uint32]]


def extract_features(
    path: Path, extractor: Extractor, max_image_size: int, max_keypoints: int, device: torch.device
) -> Features:
    """The ``max_keypoints`` strongest features of an image file, shrunk to ``max_image_size`` px
    for the network.

    Raises ``InputError`` if the image cannot be read or the device runs out of memory.
    """
    pixels = read_image(path)  # [H, W, 3]
    height, width = pixels.shape[:2]
    network_size = downscaled_size(width, height, max_size=max_image_size)
    pixels = resize_image(pixels, *network_size)
    image = torch.from_numpy(pixels.astype(np.float32) / 255.0).permute(2, 0, 1)[
        None
    ]  # [1, 3, h, w]
    try:
        with torch.inference_mode():
            keypoints, descriptors, scores = (
                part.float().cpu() for part in extractor(image.to(device))
            )
    except torch.OutOfMemoryError as error:
        size = f"{network_size[0]}x{network_size[1]}"
        raise InputError(
            f"{path.name}: {device} ran out of memory at {size} px: {GPU_MEMORY_HINT}"
        ) from error
    order = torch.sort(scores, descending=True, stable=True).indices[:max_keypoints]
    return Features(
        keypoints[order].numpy(),
        descriptors[order].numpy(),
        scores[order].numpy(),
        network_size,
        (width, height),
    )


def load_into(
    network: torch.nn.Module, state: Mapping[str, torch.Tensor], path: Path, device: torch.device
) -> None:
    """Load ``state`` into ``network``, for use on ``device``. It must hold every parameter; buffers
    may be absent."""
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
            f"weights file {path} is for another network ({len(missing)} tensors missing, "
            f"{len(unexpected)} foreign, "
            f"for example {example}): replace it"
        )
    network.to(device).eval()


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
        state = {
            name.removeprefix(prefix): value
            for name, value in state.items()
            if name.startswith(prefix)
        }
    load_into(network, state, weights, device)

    def extract(image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        height, width = image.shape[-2:]
        output = network(_gray(image))  # reads the first channel only
        size = torch.tensor([width, height], device=image.device)
        # The output is relative to the size, and keypoints are whole px, so rounding restores them.
        # The processor of transformers truncates instead, and is one px too low in 5 % of the
        # columns of some widths.
        keypoints = (output.keypoints[0] * size).round()  # [K, 2]
        # The network's own border removal is off, because it tests the right and bottom borders in
        # the wrong unit.
        inside = ((keypoints >= SUPERPOINT_BORDER) & (keypoints < size - SUPERPOINT_BORDER)).all(
            dim=1
        )
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
    load_into(network, load_state(weights), weights, device)

    def extract(image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        features = network(image)[0]
        return features.keypoints, features.descriptors, features.keypoint_scores

    return extract


def _disk(settings: FeatureSettings, weights: Path | None, device: torch.device) -> Extractor:
    from kornia.feature import DISK

    assert weights is not None
    network = DISK()
    load_into(network, load_state(weights, entry="extractor"), weights, device)

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


def _sift_kornia(
    settings: FeatureSettings, weights: Path | None, device: torch.device
) -> Extractor:
    from kornia.feature import SIFTFeatureScaleSpace, laf_is_filled

    network = SIFTFeatureScaleSpace(
        settings.max_keypoints, device=device, descriptor_backend="pyramid"
    ).eval()

    def extract(image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        frames, responses, descriptors = network(_gray(image)[:, :1])
        filled = laf_is_filled(frames)[0]  # [K]: slots stay empty in an image with few extrema
        return frames[0, filled, :, 2], descriptors[0, filled], responses[0, filled]

    return extract


def _gray(image: torch.Tensor) -> torch.Tensor:
    """The luma of ITU-R BT.601 in three equal channels [1, 3, H, W]."""
    weights = image.new_tensor([0.299, 0.587, 0.114])[None, :, None, None]
    return (image * weights).sum(dim=1, keepdim=True).expand(-1, 3, -1, -1)


# Each makes an extractor with its network on a device; the path is the checked file of weights,
# None if it needs none. They raise ``MissingWeightsError`` if the file does not fit the network.
EXTRACTORS: dict[str, Callable[[FeatureSettings, Path | None, torch.device], Extractor]] = {
    "superpoint": _superpoint,
    "aliked": _aliked,
    "disk": _disk,
    "sift_kornia": _sift_kornia,
}


def build_matcher(settings: FeatureSettings, weights: Path | None, device: torch.device) -> Matcher:
    """The matcher named in ``settings``; ``weights`` is LightGlue's checked file.

    Raises ``MissingWeightsError`` if the file does not fit the network.
    """
    if settings.matcher == "mutual_nearest":
        return mutual_nearest_matcher(settings.max_ratio, device)
    assert weights is not None
    return lightglue_matcher(settings.extractor, settings.filter_threshold, weights, device)


def mutual_nearest_matcher(max_ratio: float, device: torch.device) -> Matcher:
    """Match descriptors that are each other's nearest neighbour and pass the ratio test in both
    directions."""
    from kornia.feature import match_smnn

    def match_features(first: Features, second: Features) -> NDArray[np.uint32]:
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

    # Without a name of features, kornia does not download weights.
    no_name: Any = None
    layout = {
        key: value for key, value in LightGlue.features[extractor].items() if key != "weights"
    }
    network = LightGlue(no_name, filter_threshold=filter_threshold, **layout)
    state = load_state(weights)
    # The published files name a layer "self_attn.0", kornia's network "transformers.0.self_attn".
    for layer in range(network.conf.n_layers):
        for kind in ("self_attn", "cross_attn"):
            old, new = f"{kind}.{layer}.", f"transformers.{layer}.{kind}."
            state = {
                name.replace(old, new) if name.startswith(old) else name: tensor
                for name, tensor in state.items()
            }
    load_into(network, state, weights, device)

    def inputs(features: Features) -> dict[str, torch.Tensor]:
        return {
            "keypoints": torch.from_numpy(features.keypoints)[None].to(device),  # [1, K, 2]
            "descriptors": torch.from_numpy(features.descriptors)[None].to(device),  # [1, K, D]
            "image_size": torch.tensor(
                [features.network_size], dtype=torch.float32, device=device
            ),  # [1, 2]
        }

    def match_features(first: Features, second: Features) -> NDArray[np.uint32]:
        with torch.inference_mode():
            result = network({"image0": inputs(first), "image1": inputs(second)})
        return result["matches"][0].cpu().numpy().astype(np.uint32).reshape(-1, 2)

    return match_features


def match(matcher: Matcher, first: Features, second: Features) -> NDArray[np.uint32]:
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


CACHE_BYTES = 1 << 30  # of descriptors kept in memory while pairs are matched
# deep-image-matching's `matching_lowres`, its default choice of pairs (pairs_generator.py, state of
# December 2024)
LOWRES_SIZE = 1000  # px
LOWRES_KEYPOINTS = 2048
LOWRES_FILTER = 0.3  # lowest score of a match
LOWRES_MATCHES = 20  # pairs with more matches are matched at full size


@dataclass(frozen=True)
class NetworkJob:
    """Inputs of the isolated process. The weights are checked files, or None if a network needs
    none."""

    options: FeatureInitializer
    settings: FeatureSettings
    capture: Capture
    reference: Path | None
    work_dir: Path
    extractor_weights: Path | None
    matcher_weights: Path | None


def open_store(job: NetworkJob) -> FeatureStore:
    """The store of features and matches for the job's settings and weights."""
    extraction = {**job.settings.extraction(), "weights": _digest(job.extractor_weights)}
    matching = {**job.settings.matching(), "weights": _digest(job.matcher_weights)}
    return FeatureStore(job.work_dir, job.capture.images, extraction, matching, job.capture.masks)


def extract_and_match(job: NetworkJob, progress: Progress) -> Preparation:
    """Compute the features and matches that the store does not have yet, and report on the work.

    Raises ``InputError`` if no image has a keypoint, or no pair has a match.
    """
    options, capture = job.options, job.capture
    torch.set_num_threads(options.num_threads)
    device = select_device(options.device, "init.device")
    reference = load_reference(capture, job.reference)
    names = options.select_images(capture, reference)
    pairs = select_pairs(names, options)
    timer = Timer()
    with timer.phase("extract"):
        empty = _extract_all(job, names, device, progress)
    if len(empty) == len(names):
        raise InputError(
            f"{options.name}: no keypoint in any image: lower init.keypoint_threshold or check "
            "the photos"
        )
    if options.pairs == "lowres":
        with timer.phase("preselect"):
            small = at_low_resolution(job)
            _extract_all(small, names, device, progress)
            _match_all(small, pairs, device, progress)
    candidates, pairs = len(pairs), choose_pairs(job, names, pairs)
    with timer.phase("match"):
        without = _match_all(job, pairs, device, progress)
    if len(without) == len(pairs):  # also true if no pair was selected
        raise InputError(
            f"{options.name}: no pair of images has a match: the photos need more overlap or "
            "texture"
        )
    warnings = []
    if empty:
        warnings.append(f"no keypoint in {some_of(empty)}: no point comes from these images")
    weights = [path for path in (job.extractor_weights, job.matcher_weights) if path is not None]
    return Preparation(
        seconds=timer.seconds,
        counts={
            "pairs_selected": len(pairs),
            **(
                {"pairs_left_out": candidates - len(pairs)}
                if options.pairs in ("auto", "lowres")
                else {}
            ),
            "pairs_without_matches": len(without),
            "images_without_keypoints": len(empty),
        },
        settings={
            **job.settings.extraction(),
            **job.settings.matching(),
            "weights_sha256": {path.name: file_sha256(path) for path in weights},
        },
        warnings=tuple(warnings),
    )


def choose_pairs(
    job: NetworkJob, names: Sequence[str], pairs: list[tuple[str, str]]
) -> list[tuple[str, str]]:
    """The pairs to match, chosen by the stored features of the images ``names``."""
    if job.options.pairs == "auto":
        store = open_store(job)
        return proposed_pairs(
            names, lambda name: store.require_features(name).descriptors[:STRONGEST]
        )
    if job.options.pairs == "lowres":
        small = open_store(at_low_resolution(job))
        return [pair for pair in pairs if len(small.require_matches(*pair)) > LOWRES_MATCHES]
    return pairs


def at_low_resolution(job: NetworkJob) -> NetworkJob:
    """The same job on small images, to find the pairs that overlap."""
    settings = replace(
        job.settings,
        max_image_size=min(job.settings.max_image_size, LOWRES_SIZE),
        max_keypoints=min(job.settings.max_keypoints, LOWRES_KEYPOINTS),
        filter_threshold=max(job.settings.filter_threshold, LOWRES_FILTER),
    )
    return replace(job, settings=settings)


def _extract_all(
    job: NetworkJob, names: Sequence[str], device: torch.device, progress: Progress
) -> list[str]:
    """Store the features of all images; returns the names of images without features."""
    store, settings, empty, extractor = open_store(job), job.settings, [], None
    progress("extract", 0, len(names))
    for done, name in enumerate(names, start=1):
        features = store.read_features(name)
        if features is None:
            extractor = extractor or EXTRACTORS[settings.extractor](
                settings, job.extractor_weights, device
            )
            path = job.capture.images / name
            features = extract_features(
                path, extractor, settings.max_image_size, settings.max_keypoints, device
            )
            if name in job.capture.masks:
                features = features.within(read_mask(job.capture.masks[name]))
            store.write_features(name, features)
        if len(features.keypoints) == 0:
            empty.append(name)
        progress("extract", done, len(names))
    return empty


def _match_all(
    job: NetworkJob, pairs: Sequence[tuple[str, str]], device: torch.device, progress: Progress
) -> list[tuple[str, str]]:
    """Store the matches of all pairs; returns the pairs without a match."""
    store, matcher, without = open_store(job), None, []
    read = _cached_reader(store, pairs)
    progress("match", 0, len(pairs))
    for done, (first, second) in enumerate(pairs, start=1):
        matches = store.read_matches(first, second)
        if matches is None:
            matcher = matcher or build_matcher(job.settings, job.matcher_weights, device)
            matches = match(matcher, read(first), read(second))
            store.write_matches(first, second, matches)
        if len(matches) == 0:
            without.append((first, second))
        progress("match", done, len(pairs))
    return without


def _cached_reader(
    store: FeatureStore, pairs: Sequence[tuple[str, str]]
) -> Callable[[str], Features]:
    """`FeatureStore.require_features` with a cache of about `CACHE_BYTES` of descriptors."""
    if not pairs:
        return store.require_features
    example = store.require_features(pairs[0][0])
    return lru_cache(maxsize=2 + CACHE_BYTES // max(example.descriptors.nbytes, 1))(
        store.require_features
    )


def _digest(path: Path | None) -> str | None:
    return None if path is None else file_sha256(path)
