"""Local features of one image, with the image sizes that give them a meaning, and the settings they depend on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Features:
    """Features of one image, strongest first.

    ``keypoints`` [K, 2] float32 are px of the image as the network saw it, the centre of its first pixel being (0, 0);
    `colmap_keypoints` are the same in px of the file. ``descriptors`` are [K, D] float32, ``scores`` [K] float32.
    """

    keypoints: NDArray[np.float32]
    descriptors: NDArray[np.float32]
    scores: NDArray[np.float32]
    network_size: tuple[int, int]  # width, height in px
    file_size: tuple[int, int]

    @property
    def colmap_keypoints(self) -> NDArray[np.float32]:
        """Keypoints [K, 2] in px of the file, the centre of its first pixel being (0.5, 0.5), as COLMAP has it."""
        scale = np.array(self.file_size, dtype=np.float64) / self.network_size
        return ((self.keypoints.astype(np.float64) + 0.5) * scale).astype(np.float32)

    def within(self, mask: NDArray[np.bool_]) -> Features:
        """The features on pixels that count in ``mask`` [H, W], which is of the file's size."""
        height, width = mask.shape
        columns, rows = np.floor(self.colmap_keypoints).astype(np.int64).T  # [K] each
        kept = mask[rows.clip(0, height - 1), columns.clip(0, width - 1)]
        chosen = self.keypoints[kept], self.descriptors[kept], self.scores[kept]
        return Features(*chosen, self.network_size, self.file_size)

    def strongest(self, count: int) -> Features:
        """The first ``count`` features."""
        return Features(
            self.keypoints[:count],
            self.descriptors[:count],
            self.scores[:count],
            self.network_size,
            self.file_size,
        )


@dataclass(frozen=True, kw_only=True)
class FeatureSettings:
    """Extractor and matcher by name with their settings; a field that one of them does not read has no effect on it."""

    extractor: str
    matcher: str
    max_image_size: int  # px, longest side for the network
    max_keypoints: int
    keypoint_threshold: float = 0.0
    nms_radius: int = 0  # px
    aliked_model: str = "n16"
    filter_threshold: float = 0.0  # of LightGlue
    max_ratio: float = 1.0  # of mutual nearest neighbours

    def extraction(self) -> dict[str, object]:
        """The part that features depend on."""
        values: dict[str, object] = {
            "extractor": self.extractor,
            "max_image_size": self.max_image_size,
            "max_keypoints": self.max_keypoints,
            "keypoint_threshold": self.keypoint_threshold,
            "nms_radius": self.nms_radius,
        }
        if self.extractor == "aliked":
            values["aliked_model"] = self.aliked_model
        return values

    def matching(self) -> dict[str, object]:
        """The part that matches depend on beside the features."""
        if self.matcher == "lightglue":
            return {"matcher": self.matcher, "filter_threshold": self.filter_threshold}
        return {"matcher": self.matcher, "max_ratio": self.max_ratio}
