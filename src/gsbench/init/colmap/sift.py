"""COLMAP's own SIFT: features into the database. Calls native code that can abort: run it isolated."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import pycolmap

from gsbench.logs import Progress

IMAGES_PER_CALL = 8  # COLMAP reports no progress within a call, so it is called for a few images at a time, …
IMAGES_PER_THREAD = 2  # … and for more where many threads want work


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
    database: Path,
    images: Path,
    names: Sequence[str],
    sift: SiftSettings,
    threads: int,
    progress: Progress,
    masks: Path | None = None,
) -> None:
    """Detect and describe keypoints in the images ``names``, which are in the database.

    ``masks`` is a folder of masks as COLMAP names them: there are no keypoints where they are black.
    """
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.num_threads = threads
    options.max_image_size = sift.max_image_size
    options.sift.max_num_features = sift.max_num_features
    options.sift.peak_threshold = sift.peak_threshold
    options.sift.edge_threshold = sift.edge_threshold
    options.sift.first_octave = sift.first_octave
    reading = pycolmap.ImageReaderOptions()
    if masks is not None:
        reading.mask_path = masks
    progress("extract", 0, len(names))
    size = max(IMAGES_PER_CALL, IMAGES_PER_THREAD * threads)
    for start in range(0, len(names), size):
        part = list(names[start : start + size])
        pycolmap.extract_features(
            database,
            images,
            image_names=part,
            reader_options=reading,
            extraction_options=options,
            device=pycolmap.Device.cpu,
        )
        progress("extract", start + len(part), len(names))
