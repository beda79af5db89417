"""Rasterizers: one contract (``raster.base``), several executors (``raster.executors``), chosen by name.

Loads no torch before a rasterizer is made.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from gsbench.raster.base import CONSTANTS, RasterConstants, Rasterizer, RenderOutput
from gsbench.raster.executors import EXECUTORS, resolve

if TYPE_CHECKING:
    import torch


def resolve_name(name: str, device: torch.device) -> str:
    """The executor that ``name`` (``auto`` included) means on ``device``; raises InputError where it cannot run
    there."""
    return resolve(name, device.type).name


def create_rasterizer(name: str, device: torch.device, threads: int | None = None) -> Rasterizer:
    """The executor called ``name`` (see ``resolve_name``) for ``device``, on ``threads`` CPU threads where that
    applies."""
    executor = resolve(name, device.type)
    module, _, attribute = executor.target.rpartition(".")
    kind = getattr(importlib.import_module(module), attribute)
    rasterizer: Rasterizer = kind(threads=threads) if executor.takes_threads else kind()
    return rasterizer


__all__ = [
    "CONSTANTS",
    "EXECUTORS",
    "RasterConstants",
    "Rasterizer",
    "RenderOutput",
    "create_rasterizer",
    "resolve_name",
]
