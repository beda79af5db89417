"""COLMAP's SIFT features. Extraction calls native code that can abort: run it isolated."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pycolmap

from gsbench.init.options import SiftOptions
from gsbench.logs import Progress

# COLMAP reports no progress within a call, so it is called for a few images at a time
IMAGES_PER_CALL = 8
IMAGES_PER_THREAD = 2  # least number in a call, so that all threads have work


def extract_sift(
    database: Path,
    images: Path,
    names: Sequence[str],
    sift: SiftOptions,
    threads: int,
    progress: Progress,
    masks: Path | None = None,
) -> None:
    """Detect and describe keypoints in the database's images ``names``.

    ``masks`` is a folder of masks, named as COLMAP expects. Black pixels get no keypoints.
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
    batch_size = max(IMAGES_PER_CALL, IMAGES_PER_THREAD * threads)
    for start in range(0, len(names), batch_size):
        batch = list(names[start : start + batch_size])
        pycolmap.extract_features(
            database,
            images,
            image_names=batch,
            reader_options=reading,
            extraction_options=options,
            device=pycolmap.Device.cpu,
        )
        progress("extract", start + len(batch), len(names))
