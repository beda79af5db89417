"""Deep image matching: features and matches from networks, geometry from COLMAP.

The tables below list the weights files of the extractors and of LightGlue.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from annotated_types import Interval
from pydantic import NonNegativeFloat, PositiveInt

from gsbench.errors import InputError
from gsbench.init.base import InitReport, Preparation, Timer
from gsbench.init.networks.features import FeatureSettings
from gsbench.init.options import ColmapOptions, ImageSize, MatchRatio
from gsbench.init.reconstruction import Job, Matching, check, reconstruct
from gsbench.logs import Progress, no_progress
from gsbench.scene.types import Capture
from gsbench.settings import AnyPath, Fraction
from gsbench.weights import WeightsFile, digests_of_unpinned, find_all_weights

if TYPE_CHECKING:
    from gsbench.init.colmap.database import DatabaseTask
    from gsbench.init.networks.extract_and_match import NetworkJob

logger = logging.getLogger(__name__)

SUPERPOINT_LICENCE = "Magic Leap: academic or non-profit noncommercial research use only"

EXTRACTOR_WEIGHTS = {
    "superpoint": WeightsFile(
        (
            "superpoint.safetensors",
            "superpoint/model.safetensors",
            "lightglue_superpoint/model.safetensors",
        ),
        "https://huggingface.co/magic-leap-community/superpoint/resolve/main/model.safetensors",
    ),
    "disk": WeightsFile(  # Apache-2.0
        ("depth-save.pth",),
        "https://raw.githubusercontent.com/cvlab-epfl/disk/master/depth-save.pth",
        "9c2ee4ded238892dfa51569941372601e35e4a74aa6f84ea80053d2ab1c07abe",
    ),
}
ALIKED_WEIGHTS = {  # BSD-3-Clause
    model: WeightsFile(
        (f"aliked-{model}.pth",),
        f"https://github.com/Shiaoming/ALIKED/raw/main/models/aliked-{model}.pth",
        sha256,
    )
    for model, sha256 in {
        "n16": "5be8704840ed662d9d8c561bf7279c222092674e7eb05fd0feab94899e9d82f2",
        "n16rot": "ddf3abbf38e86f6a74540d214e1a9712c54b2d8551abc864542199f2347d7332",
        "n32": "055283fd1624d3ab46a05c3b617b1a79a3f28d1f551737eef2d653e8c8232890",
        "t16": "56782336919db220144a884e710e2b6af13b3b8f8da15b915a239078ab471085",
    }.items()
}
LIGHTGLUE_WEIGHTS = {  # Apache-2.0
    extractor: WeightsFile(
        # kornia and cvg/LightGlue use the first name, with "-pth", in the torch hub cache
        (f"{extractor}_lightglue_v0-1_arxiv-pth", f"{extractor}_lightglue.pth"),
        f"https://github.com/cvg/LightGlue/releases/download/v0.1_arxiv/{extractor}_lightglue.pth",
        sha256,
    )
    for extractor, sha256 in {
        "superpoint": None,
        "disk": "b5b21d47ea24f2c5e501aec9c91b9716e4c8c3429a4dc1e615c133c4c9378335",
        "aliked": "d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503",
    }.items()
}

Extractor = Literal["superpoint", "aliked", "disk"]
Matcher = Literal["lightglue", "mutual_nearest"]
AlikedModel = Literal["n16", "n16rot", "n32", "t16"]
# Detection scores are not comparable between extractors. The thresholds and radii are
# deep-image-matching's for superpoint, the authors' for the others.
KEYPOINT_THRESHOLDS = {"superpoint": 0.0005, "aliked": 0.2, "disk": 0.0}
NMS_RADII = {"superpoint": 3, "aliked": 2, "disk": 2}  # px


@dataclass(frozen=True, kw_only=True)
class Dim(ColmapOptions):
    """Deep image matching: SuperPoint, ALIKED or DISK; LightGlue or mutual nearest neighbours.

    ``max_image_size`` is in px of the longest side. Features and matches are stored in the
    ``work_dir`` of `run`, by image and by pair, so an interrupted run continues there.
    """

    name: ClassVar[str] = "dim"

    extractor: Extractor = "superpoint"
    # lightglue | mutual_nearest (mutual nearest neighbours with a ratio test)
    matcher: Matcher = "lightglue"
    max_keypoints: PositiveInt = 2048  # per image, the strongest
    # px, longest side for the network; keypoints are scaled back to the size of the files
    max_image_size: ImageSize = 1600
    # mutual_nearest: distance to the best over the second-best match, tested in both directions
    max_ratio: MatchRatio = 0.95
    # least detection score; null: the extractor's (superpoint 0.0005, aliked 0.2, disk 0); 0: no
    # threshold
    keypoint_threshold: NonNegativeFloat | None = None
    # px between keypoints; null: the extractor's (superpoint 3, aliked 2, disk 2)
    nms_radius: Annotated[int, Interval(ge=1, le=50)] | None = None
    aliked_model: AlikedModel = "n16"  # n16 | n16rot | n32 | t16 (LightGlue's weights are for n16)
    filter_threshold: Fraction = 0.1  # lightglue: least score of a match
    # folder with the weights files; null: $GSBENCH_WEIGHTS, then the torch hub cache
    weights: AnyPath | None = None
    download: bool = True  # fetch missing weights into the torch hub cache
    device: str = "cpu"  # of the networks

    def __post_init__(self) -> None:
        super().__post_init__()
        if (
            self.extractor == "aliked"
            and self.matcher == "lightglue"
            and self.aliked_model == "t16"
        ):
            raise InputError(
                "init.matcher=lightglue has no weights for init.aliked_model=t16: use "
                "mutual_nearest"
            )

    def run(
        self,
        capture: Capture,
        output_dir: Path,
        progress: Progress = no_progress,
        reference: Path | None = None,
        work_dir: Path | None = None,
    ) -> InitReport:
        """See `Initializer.run`. Raises ``MissingWeightsError`` if a file of weights is missing."""
        check(self, capture, reference)
        self.find_weights()
        if self.extractor == "superpoint":
            logger.warning("SuperPoint's weights are licensed by %s", SUPERPOINT_LICENCE)
        packages = ["pycolmap", "numpy", "torch", "kornia"]
        if self.extractor == "superpoint":
            packages.append("transformers")
        matching = Matching(match_stored_features, prepare_features, tuple(packages))
        return reconstruct(self, matching, capture, output_dir, progress, reference, work_dir)

    def feature_settings(self) -> FeatureSettings:
        """The settings that features and matches depend on."""
        unset = {
            "keypoint_threshold": KEYPOINT_THRESHOLDS[self.extractor],
            "nms_radius": NMS_RADII[self.extractor],
        }
        defaults = {name: value for name, value in unset.items() if getattr(self, name) is None}
        return FeatureSettings.of(self, **defaults)

    def find_weights(self) -> tuple[Path, Path | None]:
        """Checked files of weights of the extractor and the matcher, None for one without.

        Raises ``MissingWeightsError`` if a file is missing.
        """
        paths = find_all_weights(self._weights_files(), self._weights_folder(), self.download)
        return paths[0], paths[1] if len(paths) > 1 else None

    def content(self) -> str | None:
        digests = digests_of_unpinned(self._weights_files(), self._weights_folder())
        return " ".join(digests) or None

    def _weights_files(self) -> list[WeightsFile]:
        files = [
            ALIKED_WEIGHTS[self.aliked_model]
            if self.extractor == "aliked"
            else EXTRACTOR_WEIGHTS[self.extractor]
        ]
        return [*files, LIGHTGLUE_WEIGHTS[self.extractor]] if self.matcher == "lightglue" else files

    def _weights_folder(self) -> Path | None:
        return None if self.weights is None else Path(self.weights).expanduser()


def prepare_features(job: Job, progress: Progress) -> Preparation:
    """Compute features and matches by networks; runs in a process without COLMAP."""
    from gsbench.init.networks.extract_and_match import extract_and_match

    return extract_and_match(_network_job(job), progress)


def match_stored_features(
    task: DatabaseTask, job: Job, progress: Progress, timer: Timer
) -> dict[str, int]:
    """Write the stored features and matches into the database, and verify them."""
    from gsbench.init.colmap.database import write_keypoints, write_matches
    from gsbench.init.colmap.matches import verification_options, verify_pairs
    from gsbench.init.networks.extract_and_match import choose_pairs, open_store

    networks = _network_job(job)
    store = open_store(networks)
    keypoints = {name: store.require_features(name).colmap_keypoints for name in task.names}
    write_keypoints(task.database, keypoints)
    pairs = choose_pairs(networks, task.names, task.pairs)
    matches = {pair: store.require_matches(*pair) for pair in pairs}
    matches = {pair: indices for pair, indices in matches.items() if len(indices)}
    write_matches(task.database, matches)
    with timer.phase("verify"):
        verify_pairs(task.database, sorted(matches), verification_options(job.options), progress)
    return {}


def _network_job(job: Job) -> NetworkJob:
    from gsbench.init.networks.extract_and_match import NetworkJob

    dim = job.options
    assert isinstance(dim, Dim)
    weights = dim.find_weights()
    return NetworkJob(
        dim, dim.feature_settings(), dim.device, job.capture, job.reference, job.work_dir, *weights
    )
