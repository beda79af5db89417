"""The options that all initialisers share which end in COLMAP, and what they have to add: a database of matches."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from annotated_types import Ge, Interval
from pydantic import PositiveFloat

from gsbench.init.base import PointsFrom, Poses, Seed, Timer
from gsbench.init.colmap.pairs import Pairing
from gsbench.logs import Progress
from gsbench.scene.types import Capture
from gsbench.settings import Fraction, Threads, check_settings
from gsbench.system.resources import available_cores

if TYPE_CHECKING:
    import pycolmap

CameraSharing = Literal["single", "per_folder", "per_image"]
CameraModel = Literal["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"]
Intrinsics = Literal["estimate", "reference"]
MIN_DETECTION_SIZE = 32  # px: below it no detector finds anything


@dataclass(frozen=True)
class DatabaseTask:
    """Database to be filled, with cameras and images in it, and the pairs of images to be matched.

    ``images`` is a folder with the same names as the capture's in which COLMAP can read every file.
    """

    database: Path
    images: Path
    names: list[str]
    pairs: list[tuple[str, str]]
    capture: Capture
    work_dir: Path


@dataclass(frozen=True, kw_only=True)
class ColmapOptions(ABC):
    """Options shared by `Sfm`, `SfmDense`, `Dim` and `SiftKornia`.

    With ``poses=shared`` the points are triangulated under the reference cameras; with ``poses=own`` cameras and points
    are estimated and then, where a reference exists, moved into its gauge by a similarity (``align``).

    Unless ``points_from`` is ``all``, test views have no part in the points: under given cameras their photographs are
    not looked at; where cameras are estimated, all photographs make these, and of the points those of the training
    views are kept.
    """

    name: ClassVar[str]

    poses: Poses = "shared"
    align: bool = True
    camera: CameraSharing = "single"
    camera_model: CameraModel = "SIMPLE_RADIAL"
    focal_length: PositiveFloat | None = None
    intrinsics: Intrinsics = "estimate"
    pairs: Pairing = "exhaustive"
    overlap: Annotated[int, Interval(ge=1, le=60)] = 10
    min_inliers: Annotated[int, Ge(7)] = 15  # a fundamental matrix takes seven
    min_inlier_ratio: Fraction = 0.0
    mapper: Literal["auto", "incremental", "global"] = "auto"
    min_model_size: Annotated[int, Ge(2)] = 3
    two_view_tracks: bool = False
    points_from: PointsFrom = "all"
    seed: Seed = 0
    threads: Threads | Literal["auto"] = "auto"
    mapper_threads: Threads = 1

    def __post_init__(self) -> None:
        check_settings(self, "init")

    @abstractmethod
    def fill_database(self, task: DatabaseTask, progress: Progress, timer: Timer) -> dict[str, int]:
        """Write features, matches and verified geometries; runs in the isolated process. Returns counts to report."""

    @property
    def num_threads(self) -> int:
        """``threads`` as a number; ``auto`` is the cores that this process may use."""
        return available_cores() if self.threads == "auto" else self.threads

    def packages(self) -> tuple[str, ...]:
        """The packages whose versions the report states."""
        return ("pycolmap", "numpy")

    @property
    def takes_reference_cameras(self) -> bool:
        """Return whether the cameras (intrinsics at least) are the reference's where there is one."""
        return self.poses == "shared" or self.intrinsics == "reference"

    def select_images(self, capture: Capture, reference: pycolmap.Reconstruction | None) -> list[str]:
        """The sorted names of the images to be used: all, or those of the reference where its cameras are taken."""
        if reference is None or not self.takes_reference_cameras:
            return sorted(capture.image_names)
        names = sorted(image.name for image in reference.images.values() if image.has_pose)
        test = set(capture.test_names) if self.leaves_out(reference) else set()
        return [name for name in names if name not in test]

    def leaves_out(self, reference: pycolmap.Reconstruction | None) -> bool:
        """Return whether test photographs are not even looked at, which are not needed where the cameras are given."""
        return self.points_from != "all" and self.poses == "shared" and reference is not None
