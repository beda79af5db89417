"""gsbench: does an idea help 3D Gaussian Splatting? Photographs in; tables, statistics and pictures out."""

__version__ = "0.1.0"
