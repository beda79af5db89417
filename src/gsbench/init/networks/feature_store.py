"""Features and matches on disk, one file for each image and each pair, so that a killed run goes on where it was.

A file's name is the hash of all that its content depends on: the image's bytes, the settings, the weights.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbench.errors import GsbenchError
from gsbench.files import atomic, file_sha256
from gsbench.init.networks.features import Features

KEY_DIGITS = 24
FORMAT_VERSION = 1  # to be raised when the same settings give other features


class FeatureStore:
    """Store of features and matches below ``folder``: ``features/<key>.npz`` and ``matches/<key>.npy``.

    ``extraction`` and ``matching`` are the settings (plain values) that features and matches depend on, ``masks`` those
    of images by name.
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
        """The file of the features of the image ``name``."""
        return self.folder / "features" / f"{self._image_key(name)}.npz"

    def matches_path(self, first: str, second: str) -> Path:
        """The file of the matches of a pair of images."""
        key = _key([FORMAT_VERSION, self._image_key(first), self._image_key(second), self._matching])
        return self.folder / "matches" / f"{key}.npy"

    def read_features(self, name: str) -> Features | None:
        """The stored features; None where there are none, or a damaged file."""
        try:
            with np.load(self.features_path(name), allow_pickle=False) as data:
                width, height, file_width, file_height = (int(side) for side in data["sizes"])
                arrays = data["keypoints"], data["descriptors"], data["scores"]
                return Features(*arrays, (width, height), (file_width, file_height))
        except Exception:  # noqa: BLE001  numpy raises anything on a damaged file, which is then made anew
            return None

    def write_features(self, name: str, features: Features) -> None:
        """Store the features of the image ``name``."""
        with atomic(self.features_path(name), sync=False) as temporary, temporary.open("wb") as file:
            np.savez(
                file,
                keypoints=features.keypoints,
                descriptors=features.descriptors,
                scores=features.scores,
                sizes=np.array([*features.network_size, *features.file_size]),
            )

    def read_matches(self, first: str, second: str) -> NDArray[np.uint32] | None:
        """The stored matches [M, 2] of a pair; None where there are none, or a damaged file."""
        try:
            matches = np.load(self.matches_path(first, second), allow_pickle=False)
        except Exception:  # noqa: BLE001  as above
            return None
        return matches if matches.ndim == 2 and matches.shape[1] == 2 else None

    def write_matches(self, first: str, second: str, matches: NDArray[np.uint32]) -> None:
        """Store the matches [M, 2] of a pair."""
        with atomic(self.matches_path(first, second), sync=False) as temporary, temporary.open("wb") as file:
            np.save(file, matches)

    def require_features(self, name: str) -> Features:
        """The stored features, which must be there."""
        features = self.read_features(name)
        if features is None:
            raise GsbenchError(f"the stored features of {name} are gone from {self.folder}: run again")
        return features

    def require_matches(self, first: str, second: str) -> NDArray[np.uint32]:
        """The stored matches [M, 2], which must be there."""
        matches = self.read_matches(first, second)
        if matches is None:
            raise GsbenchError(f"the stored matches of {first} and {second} are gone from {self.folder}: run again")
        return matches

    def _hash_image(self, name: str) -> str:
        content = hashlib.sha256((self.images / name).read_bytes()).hexdigest()
        masks = [file_sha256(self.masks[name])] if name in self.masks else []
        return _key([FORMAT_VERSION, content, self._extraction, *masks])


def _key(value: object) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:KEY_DIGITS]
