"""Deep image matching: features and matches from networks, geometry from COLMAP."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeVar

from pydantic import NonNegativeFloat, PositiveInt, TypeAdapter

from gsbench.errors import InputError
from gsbench.files import file_sha256
from gsbench.init.base import Timer
from gsbench.init.colmap.pairs import STRONGEST, proposed_pairs
from gsbench.init.options import ImageSize, MatchRatio
from gsbench.init.sfm import Facts, Job, Reconstruction
from gsbench.logs import Progress
from gsbench.parsing import table_beside
from gsbench.scene.beside import read_mask
from gsbench.scene.types import Capture
from gsbench.settings import AnyPath, Fraction
from gsbench.weights import WeightsFile, digests_of_unpinned, find_all_weights
from gsbench.words import some_of

if TYPE_CHECKING:
    from gsbench.init.colmap.database import DatabaseTask
    from gsbench.init.networks import Features, FeatureStore, Matches

logger = logging.getLogger(__name__)
T = TypeVar("T")

CACHE_BYTES = 1 << 30  # of descriptors kept in memory while pairs are matched
BYTES_OF_KEYPOINT = 1024  # at most: 256 numbers of single precision
SUPERPOINT_LICENCE = "Magic Leap: academic or non-profit noncommercial research use only"

# the files of extractors and of LightGlue, by name
EXTRACTOR_WEIGHTS, LIGHTGLUE_WEIGHTS = (
    TypeAdapter(dict[str, WeightsFile]).validate_python(rows)
    for rows in table_beside(__file__, "weights.yaml").values()
)
Extractor = Literal["superpoint", "aliked", "disk"]
Matcher = Literal["lightglue", "mutual_nearest"]
# Detection scores are not comparable between extractors. The thresholds and radii are
# deep-image-matching's for superpoint, the authors' for the others.
DETECTION = {"superpoint": (0.0005, 3), "aliked": (0.2, 2), "disk": (0.0, 2)}  # radii in px


@dataclass(frozen=True, kw_only=True)
class Dim(Reconstruction):
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
    filter_threshold: Fraction = 0.1  # lightglue: least score of a match
    # folder with the weights files; null: $GSBENCH_WEIGHTS, then the torch hub cache
    weights: AnyPath | None = None
    download: bool = True  # fetch missing weights into the torch hub cache
    device: str = "cpu"  # of the networks

    @property
    def extraction(self) -> dict[str, Any]:
        """The settings that features depend on."""
        threshold, radius = DETECTION[self.extractor]
        return {
            "extractor": self.extractor,
            "max_image_size": self.max_image_size,
            "max_keypoints": self.max_keypoints,
            "keypoint_threshold": (
                threshold if self.keypoint_threshold is None else self.keypoint_threshold
            ),
            "nms_radius": radius,
        }

    @property
    def matching(self) -> dict[str, Any]:
        """The settings that matches depend on, in addition to the features."""
        limit = "filter_threshold" if self.matcher == "lightglue" else "max_ratio"
        return {"matcher": self.matcher, limit: getattr(self, limit)}

    def find_weights(self) -> list[Path]:
        """Checked files of weights of the extractor and, if it has some, the matcher.

        Raises ``MissingWeightsError`` if a file is missing.
        """
        return find_all_weights(*self._weights, self.download)

    def content(self) -> str | None:
        return " ".join(digests_of_unpinned(*self._weights)) or None

    @property
    def _weights(self) -> tuple[list[WeightsFile], Path | None]:
        """The files, and the folder that is searched first."""
        files = [EXTRACTOR_WEIGHTS[self.extractor]]
        if self.matcher == "lightglue":
            files.append(LIGHTGLUE_WEIGHTS[self.extractor])
        return files, None if self.weights is None else Path(self.weights).expanduser()

    def check(self, capture: Capture, reference: Path | None) -> None:
        super().check(capture, reference)
        self.find_weights()
        if self.extractor == "superpoint":
            logger.warning("SuperPoint's weights are licensed by %s", SUPERPOINT_LICENCE)

    def fill(self, job: Job, task: DatabaseTask, progress: Progress, timer: Timer) -> Facts:
        from gsbench.init.colmap.database import write_features
        from gsbench.init.colmap.matches import verify_pairs

        weights = self.find_weights()
        digests = {path.name: file_sha256(path) for path in weights}
        store = self._store(job, task.names, weights, [*digests.values()])
        pairs, counts = task.pairs, {}
        with timer.phase("extract"):
            steps = _steps(task.names, "extract", progress)
            keypoints = {name: store.features(name).colmap_keypoints for name in steps}
        empty = [name for name, points in keypoints.items() if len(points) == 0]
        if len(empty) == len(keypoints):
            raise InputError(
                f"{self.name}: no keypoint in any image: lower init.keypoint_threshold or check "
                "the photos"
            )
        if self.pairs == "auto":
            strongest = lambda name: store.features(name).descriptors[:STRONGEST]  # noqa: E731
            pairs = proposed_pairs(task.names, strongest)
            counts["pairs_left_out"] = len(task.pairs) - len(pairs)
        with timer.phase("match"):
            matches = {pair: store.matches(*pair) for pair in _steps(pairs, "match", progress)}
        found = {pair: indices for pair, indices in matches.items() if len(indices)}
        counts |= {
            "pairs_selected": len(pairs),
            "pairs_without_matches": len(pairs) - len(found),
            "images_without_keypoints": len(empty),
        }
        write_features(task.database, keypoints, found)
        with timer.phase("verify"):
            verify_pairs(task.database, self, progress)
        lack = f"no keypoint in {some_of(empty)}: no point comes from these images"
        return {
            "counts": counts,
            "settings": self.extraction | self.matching | {"weights_sha256": digests},
            "warnings": [lack] if empty else [],
            "packages": ["torch", "kornia", *["transformers"] * (self.extractor == "superpoint")],
        }

    def _store(
        self, job: Job, names: Sequence[str], weights: Sequence[Path], digests: Sequence[str]
    ) -> FeatureStore:
        """The features and matches of the job's photographs, computed where none are stored."""
        import torch

        from gsbench.init import networks
        from gsbench.system.resources import select_device

        torch.set_num_threads(self.num_threads)
        device = select_device(self.device, "init.device")
        extraction, matching = self.extraction, self.matching
        # loaded when an image needs them, since a run that is continued may need no network
        extractor = cache(
            partial(networks.EXTRACTORS[self.extractor], extraction, weights[0], device)
        )
        matcher = cache(partial(networks.build_matcher, extraction, matching, weights[-1], device))

        def extract(name: str) -> Features:
            path, mask = job.capture.images / name, job.capture.masks.get(name)
            found = networks.extract_features(path, extractor(), extraction, device)
            return found if mask is None else found.within(read_mask(mask))

        def match(*pair: Features) -> Matches:
            return networks.match(matcher(), *pair)

        room = 2 + CACHE_BYTES // (BYTES_OF_KEYPOINT * self.max_keypoints)
        folder = networks.store_folder(
            job.work_dir, job.capture, names, extraction, matching, digests
        )
        return networks.FeatureStore(folder, extract, match, room)


def _steps(items: Sequence[T], phase: str, progress: Progress) -> Iterator[T]:
    """The items, with a report of progress at the start and after each."""
    progress(phase, 0, len(items))
    for done, item in enumerate(items, start=1):
        yield item
        progress(phase, done, len(items))
