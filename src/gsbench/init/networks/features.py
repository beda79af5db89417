"""Local features of an image, and a store of them and of matches on disk.

The store has one file for each image and each pair, so that an interrupted run continues from
there. A file's name is a hash of everything that its content depends on: the image's bytes, the
mask, the settings and the weights.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsbench.files import DAMAGE, atomic, file_sha256
from gsbench.scene.types import Capture


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
    network_size: tuple[int, int]  # width, height in px
    file_size: tuple[int, int]

    @property
    def colmap_keypoints(self) -> NDArray[np.float32]:
        """Keypoints [K, 2] in px of the file, in COLMAP's convention.

        The centre of the first pixel is (0.5, 0.5).
        """
        scale = np.array(self.file_size, dtype=np.float64) / self.network_size
        return ((self.keypoints.astype(np.float64) + 0.5) * scale).astype(np.float32)

    def within(self, mask: NDArray[np.bool_]) -> Features:
        """The features on pixels that count in ``mask`` [H, W], which has the file's size."""
        height, width = mask.shape
        columns, rows = np.floor(self.colmap_keypoints).astype(np.int64).T  # [K] each
        kept = mask[rows.clip(0, height - 1), columns.clip(0, width - 1)]
        arrays = self.keypoints[kept], self.descriptors[kept], self.scores[kept]
        return Features(*arrays, self.network_size, self.file_size)


KEY_DIGITS = 24
ARRAYS = ("keypoints", "descriptors", "scores")
FORMAT_VERSION = 1  # to be raised when the same settings give different features
Matches = NDArray[np.uint32]  # indices [M, 2] of keypoints in the first and the second image


class FeatureStore:
    """Store of features and matches in ``folder``: ``features/<key>.npz``, ``matches/<key>.npy``.

    ``extraction`` and ``matching`` are the settings (plain values) that features and matches of the
    ``capture`` depend on. What is missing or damaged is computed by ``extract`` and ``match``;
    features of up to ``room`` images are kept in memory.
    """

    def __init__(
        self,
        folder: Path,
        capture: Capture,
        extraction: object,
        matching: object,
        extract: Callable[[str], Features],
        match: Callable[[Features, Features], Matches],
        room: int,
    ) -> None:
        self.folder, self.capture = folder, capture
        self._extraction, self._matching = extraction, matching
        self._extract, self._match = extract, match
        for part in ("features", "matches"):
            (folder / part).mkdir(parents=True, exist_ok=True)
        self._image_key = cache(self._hash_image)
        self.features = lru_cache(room)(self._features)

    def features_path(self, name: str) -> Path:
        """The features file of the image ``name``."""
        return self.folder / "features" / f"{self._image_key(name)}.npz"

    def matches_path(self, first: str, second: str) -> Path:
        """The matches file of a pair of images."""
        key = _key([*map(self._image_key, (first, second)), self._matching])
        return self.folder / "matches" / f"{key}.npy"

    def _features(self, name: str) -> Features:
        """The features of an image."""
        path = self.features_path(name)
        with suppress(*DAMAGE), np.load(path, allow_pickle=False) as data:
            width, height, own_width, own_height = (int(side) for side in data["sizes"])
            arrays = {name: data[name] for name in ARRAYS}
            own = own_width, own_height
            return Features(**arrays, network_size=(width, height), file_size=own)
        found = self._extract(name)
        both = np.array([*found.network_size, *found.file_size])
        with atomic(path, sync=False) as temporary, temporary.open("wb") as file:
            np.savez(file, sizes=both, **{name: getattr(found, name) for name in ARRAYS})
        return found

    def matches(self, first: str, second: str) -> Matches:
        """The matches of a pair of images."""
        path = self.matches_path(first, second)
        with suppress(*DAMAGE):
            stored: Matches = np.load(path, allow_pickle=False)
            if stored.ndim == 2 and stored.shape[1] == 2:
                return stored
        found = self._match(self.features(first), self.features(second))
        with atomic(path, sync=False) as temporary, temporary.open("wb") as file:
            np.save(file, found)
        return found

    def _hash_image(self, name: str) -> str:
        masks = self.capture.masks
        own = [file_sha256(masks[name])] if name in masks else []
        return _key([file_sha256(self.capture.images / name), self._extraction, *own])


def _key(values: list[object]) -> str:
    text = json.dumps([FORMAT_VERSION, *values], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:KEY_DIGITS]
