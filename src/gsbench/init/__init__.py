"""Initialisers, which make a COLMAP model with cameras and an initial point cloud from a capture."""

from gsbench.init.base import (
    GAUSSIANS_FILE,
    MODEL_FOLDER,
    OWN_GAUGE_FOLDER,
    PICTURE_FILE,
    REPORT_FILE,
    Gauge,
    Initializer,
    InitReport,
    PointCloud,
    PoseErrors,
    read_cloud,
)
from gsbench.init.dim import Dim, SiftKornia
from gsbench.init.placed import Carved, Dataset, Ply, Points, Random
from gsbench.init.sfm import Jittered, Sfm, SfmDense
from gsbench.logs import Progress

__all__ = [
    "GAUSSIANS_FILE",
    "MODEL_FOLDER",
    "OWN_GAUGE_FOLDER",
    "PICTURE_FILE",
    "REPORT_FILE",
    "Carved",
    "Dataset",
    "Dim",
    "Gauge",
    "InitReport",
    "Initializer",
    "Jittered",
    "Ply",
    "PointCloud",
    "Points",
    "PoseErrors",
    "Progress",
    "Random",
    "Sfm",
    "SfmDense",
    "SiftKornia",
    "read_cloud",
]
