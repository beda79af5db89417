"""COLMAP's own SIFT: features and matches into the database. Calls native code that can abort: run it isolated."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import pycolmap

from gsbench.init.base import Progress
from gsbench.init.colmap_database import image_ids_as_names, write_pairs

IMAGES_PER_CALL = 8  # COLMAP reports no progress within a call, so it is called for a few images at a time
MATCH_CALLS = 20  # … and for about a twentieth of the pairs, of which
MIN_PAIRS_PER_CALL = 50  # fewer would pay more for the start of the matcher than for the matching
MAX_PAIRS_PER_CALL = 2000


class SiftSettings(Protocol):
    """COLMAP's SIFT; see the fields of `gsbench.init.Sfm`."""

    @property
    def max_image_size(self) -> int: ...
    @property
    def max_num_features(self) -> int: ...
    @property
    def peak_threshold(self) -> float: ...
    @property
    def edge_threshold(self) -> float: ...
    @property
    def first_octave(self) -> int: ...
    @property
    def max_ratio(self) -> float: ...
    @property
    def cross_check(self) -> bool: ...
    @property
    def guided_matching(self) -> bool: ...


def extract_sift(
    database: Path, images: Path, names: Sequence[str], sift: SiftSettings, threads: int, progress: Progress
) -> None:
    """Detect and describe keypoints in the images ``names``, which are in the database."""
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.num_threads = threads
    options.max_image_size = sift.max_image_size
    options.sift.max_num_features = sift.max_num_features
    options.sift.peak_threshold = sift.peak_threshold
    options.sift.edge_threshold = sift.edge_threshold
    options.sift.first_octave = sift.first_octave
    progress("extract", 0, len(names))
    for start in range(0, len(names), IMAGES_PER_CALL):
        part = list(names[start : start + IMAGES_PER_CALL])
        pycolmap.extract_features(
            database, images, image_names=part, extraction_options=options, device=pycolmap.Device.cpu
        )
        progress("extract", start + len(part), len(names))


def match_sift(
    database: Path,
    pairs: Sequence[tuple[str, str]],
    sift: SiftSettings,
    verification: pycolmap.TwoViewGeometryOptions,
    threads: int,
    progress: Progress,
) -> None:
    """Match ``pairs`` of image names and verify them.

    The result does not depend on how the pairs are divided into calls: each pair's RANSAC starts from the seed.
    """
    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu = False
    options.num_threads = threads
    options.guided_matching = sift.guided_matching
    options.sift.max_ratio = sift.max_ratio
    options.sift.cross_check = sift.cross_check
    list_file = database.with_suffix(".pairs.txt")
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = list_file
    size = min(max(len(pairs) // MATCH_CALLS, MIN_PAIRS_PER_CALL), MAX_PAIRS_PER_CALL)
    progress("match", 0, len(pairs))
    with image_ids_as_names(database) as new_names:
        for start in range(0, len(pairs), size):
            part = pairs[start : start + size]
            write_pairs(list_file, [(new_names[first], new_names[second]) for first, second in part])
            pycolmap.match_image_pairs(
                database,
                matching_options=options,
                pairing_options=pairing,
                verification_options=verification,
                device=pycolmap.Device.cpu,
            )
            progress("match", start + len(part), len(pairs))
    list_file.unlink(missing_ok=True)
