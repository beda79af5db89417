"""The networks' part of deep image matching: features of all images, matches of all pairs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import torch

from gsbench.errors import InputError
from gsbench.files import file_sha256
from gsbench.init.base import Preparation, Timer
from gsbench.init.colmap.pairs import STRONGEST, proposed_pairs, select_pairs
from gsbench.init.colmap.reconstruct import load_reference
from gsbench.init.networks.features import Features, FeatureSettings, FeatureStore
from gsbench.init.networks.models import EXTRACTORS, build_matcher, extract_features, match
from gsbench.init.options import ColmapOptions
from gsbench.logs import Progress
from gsbench.scene.masks import read_mask
from gsbench.scene.types import Capture
from gsbench.system.device import select_device
from gsbench.words import some_of

CACHE_BYTES = 1 << 30  # of descriptors kept in memory while pairs are matched


@dataclass(frozen=True)
class NetworkJob:
    """Inputs of the isolated process. Weights are checked files, or None if not needed."""

    options: ColmapOptions
    settings: FeatureSettings
    device: str
    capture: Capture
    reference: Path | None
    work_dir: Path
    extractor_weights: Path
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
    device = select_device(job.device, "init.device")
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
    candidates, pairs = len(pairs), choose_pairs(job, names, pairs)
    with timer.phase("match"):
        without = _match_all(job, pairs, device, progress)
    if len(without) == len(pairs):  # also true if no pair was selected
        raise InputError(
            f"{options.name}: no pair of images has a match: the photos need more overlap or "
            "texture"
        )
    counts = {"pairs_selected": len(pairs)}
    if options.pairs == "auto":
        counts["pairs_left_out"] = candidates - len(pairs)
    counts |= {"pairs_without_matches": len(without), "images_without_keypoints": len(empty)}
    warnings: tuple[str, ...] = ()
    if empty:
        warnings = (f"no keypoint in {some_of(empty)}: no point comes from these images",)
    weights = [path for path in (job.extractor_weights, job.matcher_weights) if path is not None]
    digests = {path.name: file_sha256(path) for path in weights}
    settings = job.settings.extraction() | job.settings.matching() | {"weights_sha256": digests}
    return Preparation(timer.seconds, counts, settings, warnings)


def choose_pairs(
    job: NetworkJob, names: Sequence[str], pairs: list[tuple[str, str]]
) -> list[tuple[str, str]]:
    """The pairs to match, chosen by the stored features of the images ``names``."""
    if job.options.pairs == "auto":
        store = open_store(job)
        return proposed_pairs(
            names, lambda name: store.require_features(name).descriptors[:STRONGEST]
        )
    return pairs


def _extract_all(
    job: NetworkJob, names: Sequence[str], device: torch.device, progress: Progress
) -> list[str]:
    """Store the features of all images; returns the names of images without features."""
    store, settings, empty, extractor = open_store(job), job.settings, [], None
    progress("extract", 0, len(names))
    for done, name in enumerate(names, start=1):
        features = store.read_features(name)
        if features is None:
            # loaded when an image needs it, since a run that is continued may need no network
            extractor = extractor or EXTRACTORS[settings.extractor](
                settings, job.extractor_weights, device
            )
            features = extract_features(job.capture.images / name, extractor, settings, device)
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
    bytes_each = max(store.require_features(pairs[0][0]).descriptors.nbytes, 1)
    return lru_cache(maxsize=2 + CACHE_BYTES // bytes_each)(store.require_features)


def _digest(path: Path | None) -> str | None:
    return None if path is None else file_sha256(path)
