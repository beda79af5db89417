"""gsbench: does an idea help 3D Gaussian Splatting? Photographs in; tables, statistics and pictures out."""

import zlib  # noqa: F401 - loaded before pycolmap brings its own, with which Pillow's PNG writer crashes

__version__ = "0.1.0"
