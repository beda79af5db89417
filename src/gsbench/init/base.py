"""Contract of an initialiser, which makes a COLMAP model and a report from a capture."""

import json
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from annotated_types import Interval

from gsbench.errors import InputError
from gsbench.logs import Progress, no_progress
from gsbench.runs.trial_record import Oddity
from gsbench.scene.types import Array, ByteArray, Capture

# below the output folder: where COLMAP users and 3DGS trainers look for a model
MODEL_FOLDER = Path("sparse", "0")
WORK_FOLDER = "work"  # below the output folder, during a run
REPORT_FILE = "report.json"
GAUSSIANS_FILE = "gaussians.ply"  # only if training starts from given Gaussians instead of points
# share of images with a pose; with fewer, the search for a mapping goes on, and the report warns
REGISTERED_SHARE = 0.9
FIELD_OF_VIEW_DEG = (5.0, 150.0)  # plausible range, along the longest side
Poses = Literal["shared", "own"]
PointsFrom = Literal["all", "train"]
Seed = Annotated[int, Interval(ge=0, le=2**31 - 1)]  # COLMAP accepts no larger seed


class UnplacedError(InputError):
    """Error for photographs that no mapper can place by the matches that were made."""


@dataclass(frozen=True)
class Timer:
    """Adds up the wall-clock seconds of named phases."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Time the code within the context. The seconds of a repeated phase add up."""
        start = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start

    def rounded(self) -> dict[str, float]:
        """Seconds by phase, to the millisecond."""
        return {name: round(value, 3) for name, value in self.seconds.items()}


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Coloured points: ``points`` [P, 3] float64 in world units, ``colors`` [P, 3] uint8 sRGB."""

    points: Array
    colors: ByteArray

    def __post_init__(self) -> None:
        shape = len(self.points), 3
        for name, kind in (("points", "float64"), ("colors", "uint8")):
            array = getattr(self, name)
            if array.shape != shape or array.dtype != kind:
                raise ValueError(f"{name} must be {shape} {kind}, got {array.shape} {array.dtype}")

    def __len__(self) -> int:
        return len(self.points)


def read_cloud(model_dir: Path) -> PointCloud:
    """The points of the COLMAP model in ``model_dir``, ordered by their ids for reproducibility.

    Raises ``InputError`` if the folder holds no readable model.
    """
    from gsbench.scene.colmap import model_points, read_model

    return PointCloud(*model_points(read_model(model_dir)))


@dataclass(frozen=True)
class PoseErrors:
    """Errors of camera poses against a reference, after alignment by a similarity.

    Centres are in reference units, rotations in degrees. ``exact`` says that the reference is the
    truth, not another estimate. The ``_relative`` value is divided by the reference's scene extent.
    """

    num_images: int
    exact: bool
    center_rmse: float  # the absolute trajectory error (ATE)
    center_rmse_relative: float | None  # None if the extent is 0
    rotation_mean_deg: float
    rotation_max_deg: float


@dataclass(frozen=True)
class Gauge:
    """The meaning of the volume threshold V_th in the unit of length of one model.

    COLMAP models have an arbitrary scale, so one threshold selects different Gaussians in two
    models of a scene.
    """

    scene_extent: float  # 3DGS's cameras_extent of the training cameras, in the model's units
    # reference units per unit of the model; None without a reference
    scale_to_reference: float | None
    volume_threshold: float  # the paper's V_th
    # V_th / extent³, comparable between gauges; None if the extent is 0
    threshold_over_extent_cubed: float | None
    threshold_radius: float  # radius of the sphere of volume V_th, in the model's units
    threshold_radius_over_extent: float | None


@dataclass(frozen=True)
class TrainingPoints:
    """Record of a cloud made from the training views alone (``init.points_from``).

    ``removed`` is the share of the ``total`` points of all views that was dropped, negative if
    points were added. Both are None if test photographs were never matched, so that the total is
    unknown.
    """

    choice: PointsFrom
    kept: int
    total: int | None
    removed: float | None


@dataclass(frozen=True)
class InitReport:
    """Results of an initialiser; `to_dict` is the content of ``report.json``."""

    init: str
    poses: str  # shared: those of the reference; own: estimated in this run
    num_images: int
    num_registered: int
    unregistered: tuple[str, ...]
    num_points: int
    mean_reprojection_error: float | None  # px; None if no point has an observation
    mean_track_length: float | None  # images that see a point; None if no point has an observation
    focal_lengths: tuple[float, ...]  # px, one for each camera
    gauge: Gauge  # of the written model
    seconds: Mapping[str, float]
    settings: Mapping[str, Any]
    versions: Mapping[str, str]
    # None without a reference, or if the poses are those of the reference
    pose_errors: PoseErrors | None = None
    warnings: tuple[str, ...] = ()
    oddities: tuple[Oddity, ...] = ()
    # features, pairs, verified pairs, inlier matches
    counts: Mapping[str, int] = field(default_factory=dict)
    # the mapping strategy that placed the cameras (init.mapper); None if they were given
    mapped_by: str | None = None
    training_points: TrainingPoints | None = None  # None if all views contributed points

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return json.loads(json.dumps(asdict(self), default=str))  # str: paths among the settings


class Initializer(ABC):
    """Makes cameras and an initial cloud. Subclasses are dataclasses; their fields are settings.

    Examples:
        If only the points are new, derive from `PlacedCloud`. Its ``run`` adds cameras and
        report.

        >>> import numpy as np
        >>> from gsbench.init.placed import PlacedCloud
        >>> @dataclass(frozen=True, kw_only=True)
        ... class Grid(PlacedCloud):
        ...     name: ClassVar[str] = "grid"
        ...     side: int = 3  # points along each edge of a cube of 2 units
        ...
        ...     def cloud(self, capture, model):
        ...         axis = np.linspace(-1, 1, self.side)
        ...         points = np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3)  # [P, 3]
        ...         return PointCloud(points, np.full(points.shape, 128, dtype=np.uint8))

        >>> len(Grid(side=4).cloud(None, None))
        64
        >>> Grid(side="four")
        Traceback (most recent call last):
        gsbench.errors.InputError: init.side must be a whole number, got 'four'
    """

    name: ClassVar[str]  # the name in reports
    # places and colours are drawn at random, so they need not fit photographs
    random_points: ClassVar[bool] = False

    def needs_reference(self, capture: Capture) -> bool:
        """Return whether `run` needs a ``reference``, since the capture came without cameras."""
        return False

    def content(self) -> str | None:
        """The hashes of files that settings name, if the result depends on the files' content."""
        return None

    @abstractmethod
    def run(
        self,
        capture: Capture,
        output_dir: Path,
        progress: Progress = no_progress,
        reference: Path | None = None,
        work_dir: Path | None = None,
    ) -> InitReport:
        """Write a model to `MODEL_FOLDER` and a report to `REPORT_FILE`.

        Both are below ``output_dir``. The cameras have the sizes of the capture's files.
        ``reference`` is a COLMAP model of the same files whose cameras replace those of the
        capture. ``work_dir`` may keep files that a later run can reuse. Raises ``InputError`` if no
        model can be made from the capture.
        """
