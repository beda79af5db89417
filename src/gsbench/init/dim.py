"""Deep image matching: features and matches from networks, geometry from COLMAP."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from gsbench.init.base import Preparation, Timer
from gsbench.init.networks.options import NetworkOptions
from gsbench.init.reconstruction import Job, Reconstruction
from gsbench.logs import Progress
from gsbench.scene.types import Capture
from gsbench.system.isolate import run_isolated

if TYPE_CHECKING:
    from gsbench.init.colmap.database import DatabaseTask

logger = logging.getLogger(__name__)

SUPERPOINT_LICENCE = "Magic Leap: academic or non-profit noncommercial research use only"


@dataclass(frozen=True, kw_only=True)
class Dim(Reconstruction, NetworkOptions):
    """Deep image matching.

    Features and matches are stored in the ``work_dir`` of `run`, by image and by pair, so an
    interrupted run continues there.
    """

    name: ClassVar[str] = "dim"

    @property
    def packages(self) -> tuple[str, ...]:
        own = ("transformers",) if self.extractor == "superpoint" else ()
        return *super().packages, "torch", "kornia", *own

    def check(self, capture: Capture, reference: Path | None) -> None:
        super().check(capture, reference)
        self.find_weights()
        if self.extractor == "superpoint":
            logger.warning("SuperPoint's weights are licensed by %s", SUPERPOINT_LICENCE)

    def prepare(self, job: Job, progress: Progress) -> Preparation:
        what = f"{self.name}: features and matches"
        return run_isolated(self.compute, job, progress=progress, what=what)

    def compute(self, job: Job, progress: Progress) -> Preparation:
        """Compute features and matches by networks; runs in a process without COLMAP."""
        from gsbench.init.networks.extract_and_match import extract_and_match

        return extract_and_match(self, job, progress)

    def fill(
        self, job: Job, task: DatabaseTask, progress: Progress, timer: Timer
    ) -> dict[str, int]:
        from gsbench.init.colmap.database import write_features
        from gsbench.init.colmap.matches import verify_pairs
        from gsbench.init.networks.extract_and_match import choose_pairs, open_store

        store = open_store(self, job, self.find_weights())
        keypoints = {name: store.features(name).colmap_keypoints for name in task.names}
        pairs = choose_pairs(self, store, task.names, task.pairs)
        matches = {pair: store.matches(*pair) for pair in pairs}
        matches = {pair: indices for pair, indices in matches.items() if len(indices)}
        write_features(task.database, keypoints, matches)
        with timer.phase("verify"):
            verify_pairs(task.database, self, progress)
        return {}
