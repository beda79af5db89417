"""Initialisers, which make a COLMAP model with cameras and an initial cloud from a capture."""

from gsbench.init.base import MODEL_FOLDER, read_cloud
from gsbench.init.dim import Dim
from gsbench.init.placed import Dataset, Ply, Points, Random
from gsbench.init.sfm import Sfm, SfmDense

__all__ = [
    "MODEL_FOLDER",
    "Dataset",
    "Dim",
    "Ply",
    "Points",
    "Random",
    "Sfm",
    "SfmDense",
    "read_cloud",
]
