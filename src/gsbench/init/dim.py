"""Deep image matching: features and matches from networks, geometry from COLMAP; and kornia's SIFT on the same path."""

from __future__ import annotations

import logging
from abc import abstractmethod
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from gsbench.errors import InputError
from gsbench.init.base import Progress
from gsbench.init.checks import check_choice, check_integer, check_number
from gsbench.init.colmap_initializer import ColmapInitializer, Preparation
from gsbench.init.network_weights import ALIKED_WEIGHTS, EXTRACTOR_WEIGHTS, LIGHTGLUE_WEIGHTS, SUPERPOINT_LICENCE
from gsbench.init.relay import run_with_progress
from gsbench.init.timer import Timer
from gsbench.scene.types import Capture
from gsbench.weights import find_weights

if TYPE_CHECKING:
    from gsbench.init.colmap_database import CameraGroup
    from gsbench.init.extractors import ExtractorSettings
    from gsbench.init.matching import MatcherSettings

logger = logging.getLogger(__name__)

DEEP_EXTRACTORS = ("superpoint", "aliked", "disk")
MATCHERS = ("lightglue", "mutual_nearest")
ALIKED_MODELS = ("n16", "n16rot", "n32", "t16")
# detection scores are not comparable between extractors; these are deep-image-matching's (superpoint) and the authors'
KEYPOINT_THRESHOLDS = {"superpoint": 0.0005, "aliked": 0.2, "disk": 0.0}
NMS_RADII = {"superpoint": 3, "aliked": 2, "disk": 2}  # px


@dataclass(frozen=True)
class NetworkJob:
    """What the isolated process needs to extract and match."""

    capture: Capture
    reference: Path | None
    work_dir: Path
    pairing: ColmapInitializer
    extractor: ExtractorSettings
    matcher: MatcherSettings
    extractor_weights: Path | None
    matcher_weights: Path | None
    max_image_size: int
    device: str
    threads: int
