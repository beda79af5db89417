"""Rasterizers: one contract (``raster.base``), several executors (``raster.executors``).

Does not import torch until a rasterizer is made.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from gsbench.raster.base import CONSTANTS, RasterConstants, Rasterizer, RenderOutput
from gsbench.raster.executors import EXECUTORS, resolve

if TYPE_CHECKING:
    import torch


def create_rasterizer(name: str, device: torch.device, threads: int | None = None) -> Rasterizer:
    """Make the rasterizer called ``name``, or for ``auto`` the best one for ``device``.

    ``threads`` limits the CPU threads of ``cpu``. Raises InputError if it cannot run on ``device``.
    """
    executor = resolve(name, device.type)
    module, _, attribute = executor.target.rpartition(".")
    rasterizer_class = getattr(importlib.import_module(module), attribute)
    rasterizer: Rasterizer = (
        rasterizer_class(threads=threads) if executor.takes_threads else rasterizer_class()
    )
    return rasterizer


__all__ = [
    "CONSTANTS",
    "EXECUTORS",
    "RasterConstants",
    "Rasterizer",
    "RenderOutput",
    "create_rasterizer",
]
