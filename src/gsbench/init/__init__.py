"""Initialisers, which make a COLMAP model with cameras and an initial cloud from a capture."""

from gsbench.init.base import MODEL_FOLDER, read_cloud
from gsbench.init.dim import Dim, SiftKornia
from gsbench.init.placed import Carved, Dataset, Ply, Points, Random
from gsbench.init.sfm import Jittered, Sfm, SfmDense

__all__ = [
    "MODEL_FOLDER",
    "Carved",
    "Dataset",
    "Dim",
    "Jittered",
    "Ply",
    "Points",
    "Random",
    "Sfm",
    "SfmDense",
    "SiftKornia",
    "read_cloud",
]
