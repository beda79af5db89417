"""Settings of deep image matching, and the weights files of extractors and of LightGlue."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Interval
from pydantic import NonNegativeFloat, PositiveInt

from gsbench.errors import InputError
from gsbench.init.options import ColmapOptions, ImageSize, MatchRatio
from gsbench.settings import AnyPath, Fraction
from gsbench.weights import WeightsFile, digests_of_unpinned, find_all_weights

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
DETECTION = {"superpoint": (0.0005, 3), "aliked": (0.2, 2), "disk": (0.0, 2)}  # radii in px


@dataclass(frozen=True, kw_only=True)
class NetworkOptions(ColmapOptions):
    """The settings of `Dim`: SuperPoint, ALIKED or DISK; LightGlue or mutual nearest neighbours.

    ``max_image_size`` is in px of the longest side.
    """

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
        choice = self.extractor, self.matcher, self.aliked_model
        if choice == ("aliked", "lightglue", "t16"):
            raise InputError(
                "init.matcher=lightglue has no weights for init.aliked_model=t16: use "
                "mutual_nearest"
            )

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
            "nms_radius": radius if self.nms_radius is None else self.nms_radius,
        } | ({"aliked_model": self.aliked_model} if self.extractor == "aliked" else {})

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
        aliked = self.extractor == "aliked"
        files = [ALIKED_WEIGHTS[self.aliked_model] if aliked else EXTRACTOR_WEIGHTS[self.extractor]]
        if self.matcher == "lightglue":
            files.append(LIGHTGLUE_WEIGHTS[self.extractor])
        return files, None if self.weights is None else Path(self.weights).expanduser()
