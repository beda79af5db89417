"""What features and matches of an image depend on, apart from its pixels and the weights."""

from __future__ import annotations

from dataclasses import dataclass


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
