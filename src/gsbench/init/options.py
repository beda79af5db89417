"""Settings of the initialisers that reconstruct with COLMAP.

They are apart from the initialisers, so that features, matching and mapping depend on settings and
not on the initialisers that call them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from annotated_types import Ge, Interval
from pydantic import PositiveFloat, PositiveInt

from gsbench.init.base import Initializer, PointsFrom, Poses, Seed
from gsbench.scene.types import Capture
from gsbench.settings import Fraction, Threads, check_settings
from gsbench.system.resources import available_cores

if TYPE_CHECKING:
    import pycolmap

Pairing = Literal["exhaustive", "auto", "sequential"]
CameraSharing = Literal["exif", "single", "per_folder", "per_image"]
CameraModel = Literal[
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"
]
ImageSize = Annotated[int, Ge(32)]  # px: detectors find nothing in smaller images
MatchRatio = Annotated[float, Interval(gt=0, le=1)]  # distance to the best over the second-best


@dataclass(frozen=True, kw_only=True)
class ColmapOptions(Initializer):
    """The settings that `Sfm`, `SfmDense` and `Dim` share.

    With ``poses=shared``, points are triangulated under the reference cameras. With ``poses=own``,
    cameras and points are estimated; if there is a reference and ``align`` is set, a similarity
    then moves them into its gauge.

    With ``points_from=train``, test views contribute no points. Under given cameras their
    photographs are not read. If cameras are estimated, all photographs are used for the cameras,
    and only points of training views are kept.

    The reference is the ``reference`` given to `run`, else the model that came with the capture.
    """

    # estimates the poses itself if poses=shared and there is no reference
    is_own_reference: ClassVar[bool] = False

    # shared: points under the reference cameras (the scene's, or those of init=sfm) | own:
    # estimated here
    poses: Poses = "shared"
    # own poses: move the model into the gauge of the reference (false: keep COLMAP's gauge)
    align: bool = True
    # estimated cameras: exif (one for each size, camera, lens and focal length in EXIF) | single
    # (one for each size) | per_folder | per_image
    camera: CameraSharing = "exif"
    camera_model: CameraModel = "SIMPLE_RADIAL"
    # px of the image files, an initial value; null: from EXIF, else 1.2 x the longest side
    focal_length: PositiveFloat | None = None
    # exhaustive | auto (above 30 images, pairs that a preview proposes) | sequential (file names
    # in the order of shooting)
    pairs: Pairing = "exhaustive"
    # sequential: neighbours on each side, and as many at distances 1, 2, 4, 8, …
    overlap: Annotated[int, Interval(ge=1, le=60)] = 10
    min_inliers: Annotated[int, Ge(7)] = 15  # a fundamental matrix needs seven
    min_inlier_ratio: Fraction = 0.0  # the same, as a share of the pair's matches
    # auto (incremental; if it places few images: smaller angles, global, assumed focal lengths) |
    # incremental | global
    mapper: Literal["auto", "incremental", "global"] = "auto"
    # keep points that only two images see: 1.7 times the points of sfm, but less accurate
    two_view_tracks: bool = False
    # all views | train (test views contribute no points or colours: docs/splits.md)
    points_from: PointsFrom = "all"
    seed: Seed = 0  # of RANSAC and mapper
    # of extraction and matching; results of SIFT do not depend on it, results of networks are
    # repeatable for 1
    threads: Threads | Literal["auto"] = "auto"
    # of mapping and triangulation; 2 and more are faster on large scenes and not repeatable to
    # the bit
    mapper_threads: Threads = 1

    def __post_init__(self) -> None:
        check_settings(self, "init")

    def needs_reference(self, capture: Capture) -> bool:
        """Return whether `run` needs a ``reference`` because the capture came without cameras."""
        return capture.model is None and self.poses == "shared" and not self.is_own_reference

    @property
    def num_threads(self) -> int:
        """``threads`` as a number; ``auto`` is the number of cores that this process may use."""
        return available_cores() if self.threads == "auto" else self.threads

    def ignores_test_photographs(self, reference: pycolmap.Reconstruction | None) -> bool:
        """Return whether test photographs are not read at all: given cameras do not need them."""
        return self.points_from != "all" and self.poses == "shared" and reference is not None

    def select_images(
        self, capture: Capture, reference: pycolmap.Reconstruction | None
    ) -> list[str]:
        """The sorted names of the images to use: those of the reference if its cameras are used."""
        if reference is None or self.poses == "own":
            return sorted(capture.image_names)
        names = {image.name for image in reference.images.values() if image.has_pose}
        if self.ignores_test_photographs(reference):
            names -= set(capture.test_names)
        return sorted(names)


@dataclass(frozen=True, kw_only=True)
class SiftOptions(ColmapOptions):
    """The settings of COLMAP's SIFT features and of their matching.

    ``max_image_size`` is in px of the longest side. Larger images are shrunk for detection, and
    keypoints are scaled back to the files' size.
    """

    # px, longest side for detection; keypoints are scaled back to the size of the files
    max_image_size: ImageSize = 1600
    max_num_features: PositiveInt = 8192  # per image
    peak_threshold: PositiveFloat = 0.02 / 3  # COLMAP's default, as is the next
    # ratio of curvatures (COLMAP's default); higher: more points along edges
    edge_threshold: PositiveFloat = 10.0
    # -1 doubles the image before detection; 0 is several times faster, with fewer points
    first_octave: Annotated[int, Interval(ge=-1, le=5)] = -1
    max_ratio: MatchRatio = 0.8  # distance to the best over the second-best match
