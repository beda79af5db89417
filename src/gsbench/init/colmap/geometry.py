"""Geometric verification of matched pairs by COLMAP."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pycolmap

from gsbench.init.colmap.database import image_ids_as_names, write_pairs
from gsbench.init.options import ColmapOptions
from gsbench.logs import Progress

# COLMAP reports no progress within a call, so the pairs are divided over several calls
VERIFY_CALLS = 20
MIN_PAIRS_PER_CALL = 50


def verification_options(options: ColmapOptions) -> pycolmap.TwoViewGeometryOptions:
    """The options of COLMAP's geometric verification of a pair."""
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = options.seed
    verification.min_num_inliers = options.min_inliers
    verification.min_inlier_ratio = options.min_inlier_ratio
    return verification


def verify_pairs(
    path: Path,
    pairs: Sequence[tuple[str, str]],
    options: pycolmap.TwoViewGeometryOptions,
    progress: Progress,
) -> None:
    """Run COLMAP's geometric verification on the stored matches of ``pairs``."""
    list_file = path.with_suffix(".pairs.txt")
    size = max(len(pairs) // VERIFY_CALLS, MIN_PAIRS_PER_CALL)
    progress("verify", 0, len(pairs))
    with image_ids_as_names(path) as new_names:
        for start in range(0, len(pairs), size):
            part = pairs[start : start + size]
            write_pairs(
                list_file, [(new_names[first], new_names[second]) for first, second in part]
            )
            pycolmap.verify_matches(path, list_file, options)
            progress("verify", start + len(part), len(pairs))
    list_file.unlink(missing_ok=True)
