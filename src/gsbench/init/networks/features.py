"""Local features of an image, and a store of them and of matches on disk.

The store has one file for each image and each pair, so that an interrupted run continues from
there. The name of its folder is a hash of everything that the files depend on: the photographs, the
masks, the settings and the weights.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbench.files import DAMAGE, atomic, file_sha256
from gsbench.runs.configuration import sha256_of
from gsbench.scene.types import Capture, Mask

Size = NDArray[np.int64] | tuple[int, int]


@dataclass(frozen=True, eq=False)
class Features:
    """Features of one image, strongest first.

    ``keypoints`` [K, 2] float32 are in px of the image at the network's size, with the centre of
    the first pixel at (0, 0). `colmap_keypoints` are in px of the file. ``descriptors`` are [K, D]
    float32, ``scores`` [K] float32.
    """

    keypoints: NDArray[np.float32]
    descriptors: NDArray[np.float32]
    scores: NDArray[np.float32]
    network_size: Size  # width, height in px
    file_size: Size

    @property
    def colmap_keypoints(self) -> NDArray[np.float32]:
        """Keypoints [K, 2] in px of the file, in COLMAP's convention.

        The centre of the first pixel is (0.5, 0.5).
        """
        scale = np.array(self.file_size, dtype=np.float64) / self.network_size
        return ((self.keypoints.astype(np.float64) + 0.5) * scale).astype(np.float32)

    def within(self, mask: Mask) -> Features:
        """The features on pixels that count in ``mask`` [H, W], which has the file's size."""
        height, width = mask.shape
        columns, rows = np.floor(self.colmap_keypoints).astype(np.int64).T  # [K] each
        kept = mask[rows.clip(0, height - 1), columns.clip(0, width - 1)]
        arrays = self.keypoints[kept], self.descriptors[kept], self.scores[kept]
        return Features(*arrays, self.network_size, self.file_size)


FORMAT_VERSION = 2  # to be raised when the same settings give different files
Matches = NDArray[np.uint32]  # indices [M, 2] of keypoints in the first and the second image


def store_folder(work: Path, capture: Capture, names: Sequence[str], *settings: object) -> Path:
    """The folder below ``work`` for features and matches of the images ``names``."""
    hashes = [
        [file_sha256(file) for file in (capture.images / name, capture.masks.get(name)) if file]
        for name in names
    ]
    return work / "features" / sha256_of([FORMAT_VERSION, list(names), hashes, *settings])


class FeatureStore:
    """Store of features and matches in ``folder`` (`store_folder`), a file each.

    What is missing or damaged is computed by ``extract`` and ``match``; features of up to ``room``
    images are kept in memory.
    """

    def __init__(
        self,
        folder: Path,
        extract: Callable[[str], Features],
        match: Callable[[Features, Features], Matches],
        room: int,
    ) -> None:
        self.folder, self._extract, self._match = folder, extract, match
        folder.mkdir(parents=True, exist_ok=True)
        self.features = lru_cache(room)(self._features)

    def path(self, *names: str) -> Path:
        """The file of an image, or of a pair of images."""
        return self.folder / f"{hashlib.sha256(repr(names).encode()).hexdigest()}.npz"

    def _features(self, name: str) -> Features:
        """The features of an image."""
        return Features(**self._stored(lambda: vars(self._extract(name)), name))

    def matches(self, *pair: str) -> Matches:
        """The matches of a pair of images."""
        found = self._stored(lambda: {"found": self._match(*map(self.features, pair))}, *pair)
        matches: Matches = found["found"]
        return matches

    def _stored(self, make: Callable[[], Mapping[str, Any]], *names: str) -> Mapping[str, Any]:
        """The arrays in the file of ``names``, which ``make`` returns if it cannot be read."""
        path = self.path(*names)
        with suppress(*DAMAGE), np.load(path, allow_pickle=False) as data:
            return dict(data)
        made = make()
        with atomic(path, sync=False) as temporary, temporary.open("wb") as file:
            np.savez(file, **made)
        return made
