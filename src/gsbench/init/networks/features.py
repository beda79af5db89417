"""Local features of an image, the settings that they depend on, and a store of them on disk.

The store has one file for each image and each pair, so that an interrupted run continues from
there. A file's name is a hash of everything that its content depends on: the image's bytes, the
mask, the settings and the weights.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbench.errors import GsbenchError
from gsbench.files import DAMAGE, atomic, file_sha256


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


@dataclass(frozen=True, kw_only=True)
class FeatureSettings:
    """Names and settings of an extractor and a matcher, which ignore fields that are not theirs."""

    extractor: str
    matcher: str
    max_image_size: int  # px, longest side for the network
    max_keypoints: int
    keypoint_threshold: float = 0.0
    nms_radius: int = 0  # px
    aliked_model: str = "n16"
    filter_threshold: float = 0.0  # LightGlue only
    max_ratio: float = 1.0  # mutual nearest neighbours only

    @classmethod
    def of(cls, options: object, **others: Any) -> FeatureSettings:
        """The settings in attributes of ``options``, replaced or completed by ``others``."""
        names = [entry.name for entry in fields(cls) if hasattr(options, entry.name)]
        return cls(**({name: getattr(options, name) for name in names} | others))

    def extraction(self) -> dict[str, object]:
        """The settings that features depend on."""
        names = ["extractor", "max_image_size", "max_keypoints", "keypoint_threshold", "nms_radius"]
        if self.extractor == "aliked":
            names.append("aliked_model")
        return {name: getattr(self, name) for name in names}

    def matching(self) -> dict[str, object]:
        """The settings that matches depend on, in addition to the features."""
        limit = "filter_threshold" if self.matcher == "lightglue" else "max_ratio"
        return {name: getattr(self, name) for name in ("matcher", limit)}


KEY_DIGITS = 24
FORMAT_VERSION = 1  # to be raised when the same settings give different features


class FeatureStore:
    """Store of features and matches in ``folder``: ``features/<key>.npz``, ``matches/<key>.npy``.

    ``extraction`` and ``matching`` are the settings (plain values) that features and matches depend
    on. ``masks`` are mask files by image name.
    """

    def __init__(
        self,
        folder: Path,
        images: Path,
        extraction: Mapping[str, Any],
        matching: Mapping[str, Any],
        masks: Mapping[str, Path] = MappingProxyType({}),
    ) -> None:
        self.folder, self.images, self.masks = folder, images, masks
        self._extraction, self._matching = dict(extraction), dict(matching)
        for part in ("features", "matches"):
            (folder / part).mkdir(parents=True, exist_ok=True)
        self._image_key = cache(self._hash_image)

    def features_path(self, name: str) -> Path:
        """The features file of the image ``name``."""
        return self.folder / "features" / f"{self._image_key(name)}.npz"

    def matches_path(self, first: str, second: str) -> Path:
        """The matches file of a pair of images."""
        key = _key(
            [FORMAT_VERSION, self._image_key(first), self._image_key(second), self._matching]
        )
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

    def write_features(self, name: str, features: Features) -> None:
        """Store the features of the image ``name``."""
        with (
            atomic(self.features_path(name), sync=False) as temporary,
            temporary.open("wb") as file,
        ):
            np.savez(
                file,
                keypoints=features.keypoints,
                descriptors=features.descriptors,
                scores=features.scores,
                sizes=np.array([*features.network_size, *features.file_size]),
            )

    def read_matches(self, first: str, second: str) -> NDArray[np.uint32] | None:
        """The stored matches [M, 2] of a pair, or None if the file is missing or damaged."""
        try:
            matches = np.load(self.matches_path(first, second), allow_pickle=False)
        except DAMAGE:
            return None
        return matches if matches.ndim == 2 and matches.shape[1] == 2 else None

    def write_matches(self, first: str, second: str, matches: NDArray[np.uint32]) -> None:
        """Store the matches [M, 2] of a pair."""
        with (
            atomic(self.matches_path(first, second), sync=False) as temporary,
            temporary.open("wb") as file,
        ):
            np.save(file, matches)

    def require_features(self, name: str) -> Features:
        """The stored features; raises ``GsbenchError`` if they are missing."""
        features = self.read_features(name)
        if features is None:
            raise GsbenchError(
                f"the stored features of {name} are gone from {self.folder}: run again"
            )
        return features

    def require_matches(self, first: str, second: str) -> NDArray[np.uint32]:
        """The stored matches [M, 2] of a pair; raises ``GsbenchError`` if they are missing."""
        matches = self.read_matches(first, second)
        if matches is None:
            raise GsbenchError(
                f"the stored matches of {first} and {second} are gone from {self.folder}: run again"
            )
        return matches

    def _hash_image(self, name: str) -> str:
        content = hashlib.sha256((self.images / name).read_bytes()).hexdigest()
        masks = [file_sha256(self.masks[name])] if name in self.masks else []
        return _key([FORMAT_VERSION, content, self._extraction, *masks])


def _key(value: object) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:KEY_DIGITS]
