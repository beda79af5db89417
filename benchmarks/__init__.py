"""Benchmarks beside `gsbench bench`."""

import gsbench  # noqa: F401  (before torch, whose idle threads would spin)
