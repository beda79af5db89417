"""Local features of an image, and a store of them and of matches on disk.

The store has one file for each image and each pair, so that an interrupted run continues from
there. A file's name is a hash of everything that its content depends on: the image's bytes, the
mask, the settings and the weights.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import BinaryIO, TypeVar

import numpy as np
from numpy.typing import NDArray

from gsbench.errors import GsbenchError
from gsbench.files import DAMAGE, atomic, file_sha256
from gsbench.scene.types import Capture

T = TypeVar("T")


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
        return self[kept]

    def __getitem__(self, chosen: slice | NDArray[np.bool_]) -> Features:
        """The features with the ``chosen`` indices."""
        arrays = self.keypoints[chosen], self.descriptors[chosen], self.scores[chosen]
        return Features(*arrays, self.network_size, self.file_size)


KEY_DIGITS = 24
FORMAT_VERSION = 1  # to be raised when the same settings give different features
Matches = NDArray[np.uint32]  # indices [M, 2] of keypoints in the first and the second image


class FeatureStore:
    """Store of features and matches in ``folder``: ``features/<key>.npz``, ``matches/<key>.npy``.

    ``extraction`` and ``matching`` are the settings (plain values) that features and matches of the
    ``capture`` depend on.
    """

    def __init__(
        self, folder: Path, capture: Capture, extraction: object, matching: object
    ) -> None:
        self.folder, self.capture = folder, capture
        self._extraction, self._matching = extraction, matching
        for part in ("features", "matches"):
            (folder / part).mkdir(parents=True, exist_ok=True)
        self._image_key = cache(self._hash_image)

    def features_path(self, name: str) -> Path:
        """The features file of the image ``name``."""
        return self.folder / "features" / f"{self._image_key(name)}.npz"

    def matches_path(self, first: str, second: str) -> Path:
        """The matches file of a pair of images."""
        key = _key([*map(self._image_key, (first, second)), self._matching])
        return self.folder / "matches" / f"{key}.npy"

    def read_features(self, name: str) -> Features | None:
        """The stored features, or None if the file is missing or damaged."""
        try:
            with np.load(self.features_path(name), allow_pickle=False) as data:
                width, height, file_width, file_height = (int(side) for side in data["sizes"])
                arrays = data["keypoints"], data["descriptors"], data["scores"]
                return Features(*arrays, (width, height), (file_width, file_height))
        except DAMAGE:
            return None  # the file is made again

    def read_matches(self, first: str, second: str) -> Matches | None:
        """The stored matches of a pair, or None if the file is missing or damaged."""
        try:
            matches = np.load(self.matches_path(first, second), allow_pickle=False)
        except DAMAGE:
            return None
        return matches if matches.ndim == 2 and matches.shape[1] == 2 else None

    def write_features(self, name: str, features: Features) -> None:
        """Store the features of the image ``name``."""
        sizes = np.array([*features.network_size, *features.file_size])
        arrays = {key: getattr(features, key) for key in ("keypoints", "descriptors", "scores")}
        with self._written(self.features_path(name)) as file:
            np.savez(file, sizes=sizes, **arrays)

    def write_matches(self, first: str, second: str, matches: Matches) -> None:
        """Store the matches of a pair."""
        with self._written(self.matches_path(first, second)) as file:
            np.save(file, matches)

    def features(self, name: str) -> Features:
        """The stored features; raises ``GsbenchError`` if they are missing."""
        return self._found(self.read_features(name), f"features of {name}")

    def matches(self, first: str, second: str) -> Matches:
        """The stored matches of a pair; raises ``GsbenchError`` if they are missing."""
        return self._found(self.read_matches(first, second), f"matches of {first} and {second}")

    def _found(self, stored: T | None, what: str) -> T:
        if stored is None:
            raise GsbenchError(f"the stored {what} are gone from {self.folder}: run again")
        return stored

    @contextmanager
    def _written(self, path: Path) -> Iterator[BinaryIO]:
        with atomic(path, sync=False) as temporary, temporary.open("wb") as file:
            yield file

    def _hash_image(self, name: str) -> str:
        masks = self.capture.masks
        own = [file_sha256(masks[name])] if name in masks else []
        return _key([file_sha256(self.capture.images / name), self._extraction, *own])


def _key(values: list[object]) -> str:
    text = json.dumps([FORMAT_VERSION, *values], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:KEY_DIGITS]
