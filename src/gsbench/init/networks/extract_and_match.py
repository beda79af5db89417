"""The networks' part of deep image matching: features of all images, matches of all pairs."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import torch

from gsbench.errors import InputError
from gsbench.files import file_sha256
from gsbench.init.base import Preparation, Timer
from gsbench.init.colmap.pairs import STRONGEST, proposed_pairs, select_pairs
from gsbench.init.colmap.reconstruct import load_reference
from gsbench.init.networks.features import FeatureStore
from gsbench.init.networks.models import EXTRACTORS, build_matcher, extract_features, match
from gsbench.init.networks.options import NetworkOptions
from gsbench.init.reconstruction import Job
from gsbench.logs import Progress
from gsbench.scene.masks import read_mask
from gsbench.system.device import select_device
from gsbench.words import some_of

CACHE_BYTES = 1 << 30  # of descriptors kept in memory while pairs are matched
BYTES_OF_KEYPOINT = 1024  # at most: 256 numbers of single precision

Pair = tuple[str, str]


def open_store(options: NetworkOptions, job: Job, weights: Sequence[Path]) -> FeatureStore:
    """The store of features and matches for these settings and weights."""
    digests = [*map(file_sha256, weights), None]
    extraction = {**options.extraction, "weights": digests[0]}
    matching = {**options.matching, "weights": digests[1]}
    return FeatureStore(job.work_dir, job.capture, extraction, matching)


def extract_and_match(options: NetworkOptions, job: Job, progress: Progress) -> Preparation:
    """Compute the features and matches that the store does not have yet, and report on the work.

    Raises ``InputError`` if no image has a keypoint, or no pair has a match.
    """
    torch.set_num_threads(options.num_threads)
    device, weights = select_device(options.device, "init.device"), options.find_weights()
    store = open_store(options, job, weights)
    names = options.select_images(job.capture, load_reference(job.capture, job.reference))
    candidates, timer = select_pairs(names, options), Timer()
    with timer.phase("extract"):
        empty = _extract_all(options, store, weights[0], names, device, progress)
    if len(empty) == len(names):
        raise InputError(
            f"{options.name}: no keypoint in any image: lower init.keypoint_threshold or check "
            "the photos"
        )
    pairs = choose_pairs(options, store, names, candidates)
    with timer.phase("match"):
        without = _match_all(options, store, weights, pairs, device, progress)
    if without == len(pairs):  # also true if no pair was selected
        raise InputError(
            f"{options.name}: no pair of images has a match: the photos need more overlap or "
            "texture"
        )
    counts = {"pairs_selected": len(pairs)}
    if options.pairs == "auto":
        counts["pairs_left_out"] = len(candidates) - len(pairs)
    counts |= {"pairs_without_matches": without, "images_without_keypoints": len(empty)}
    warnings: tuple[str, ...] = ()
    if empty:
        warnings = (f"no keypoint in {some_of(empty)}: no point comes from these images",)
    digests = {path.name: file_sha256(path) for path in weights}
    settings = options.extraction | options.matching | {"weights_sha256": digests}
    return Preparation(timer.seconds, counts, settings, warnings)


def choose_pairs(
    options: NetworkOptions, store: FeatureStore, names: Sequence[str], pairs: list[Pair]
) -> list[Pair]:
    """The pairs to match, chosen by the stored features of the images ``names``."""
    if options.pairs != "auto":
        return pairs
    return proposed_pairs(names, lambda name: store.features(name).descriptors[:STRONGEST])


def _extract_all(
    options: NetworkOptions,
    store: FeatureStore,
    weights: Path,
    names: Sequence[str],
    device: torch.device,
    progress: Progress,
) -> list[str]:
    """Store the features of all images; returns the names of images without features."""
    settings, capture, empty, extractor = options.extraction, store.capture, [], None
    progress("extract", 0, len(names))
    for done, name in enumerate(names, start=1):
        features = store.read_features(name)
        if features is None:
            # loaded when an image needs it, since a run that is continued may need no network
            extractor = extractor or EXTRACTORS[options.extractor](settings, weights, device)
            features = extract_features(capture.images / name, extractor, settings, device)
            if name in capture.masks:
                features = features.within(read_mask(capture.masks[name]))
            store.write_features(name, features)
        if len(features.keypoints) == 0:
            empty.append(name)
        progress("extract", done, len(names))
    return empty


def _match_all(
    options: NetworkOptions,
    store: FeatureStore,
    weights: Sequence[Path],
    pairs: Sequence[Pair],
    device: torch.device,
    progress: Progress,
) -> int:
    """Store the matches of all pairs; returns the number of pairs without a match."""
    matcher, without = None, 0
    read = lru_cache(2 + CACHE_BYTES // (BYTES_OF_KEYPOINT * options.max_keypoints))(store.features)
    progress("match", 0, len(pairs))
    for done, (first, second) in enumerate(pairs, start=1):
        matches = store.read_matches(first, second)
        if matches is None:
            matcher = matcher or build_matcher(options, weights, device)
            matches = match(matcher, read(first), read(second))
            store.write_matches(first, second, matches)
        without += len(matches) == 0
        progress("match", done, len(pairs))
    return without
