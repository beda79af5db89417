"""Rasterizers: one contract (``raster.base``), several executors, chosen by name."""

from __future__ import annotations

import importlib.util
import logging

import torch

from gsbench.errors import InputError
from gsbench.raster.base import CONSTANTS, RasterConstants, Rasterizer, RenderOutput

log = logging.getLogger(__name__)

NAMES = ("reference", "cpu", "cuda")


def resolve_name(name: str, device: torch.device) -> str:
    """The executor that ``name`` (``auto`` included) means on ``device``; raises InputError where it cannot run
    there."""
    if name == "auto":
        if device.type == "cpu":
            return "cpu"
        if device.type == "cuda" and importlib.util.find_spec("gsplat") is not None:
            return "cuda"
        log.warning(
            "raster=auto: gsplat is not installed, so the slow reference rasterizer runs; pip install 'gsbench[cuda]'"
        )
        return "reference"
    if name not in NAMES:
        raise InputError(f"raster={name} is not known; choose auto, {', '.join(NAMES)}")
    if name == "cpu" and device.type != "cpu":
        raise InputError(f"raster=cpu runs on device=cpu, not on {device}; use raster=cuda or device=cpu")
    if name == "cuda" and device.type != "cuda":
        raise InputError(
            f"raster=cuda needs a CUDA device and device is {device}; use raster=cpu, or device=cuda on a GPU machine"
        )
    if name == "cuda" and importlib.util.find_spec("gsplat") is None:
        raise InputError("raster=cuda needs gsplat: pip install 'gsbench[cuda]'")
    return name


def create_rasterizer(name: str, device: torch.device, threads: int | None = None) -> Rasterizer:
    """The executor called ``name`` (see ``resolve_name``) for ``device``, on ``threads`` CPU threads where that
    applies."""
    resolved = resolve_name(name, device)
    if resolved == "cpu":
        from gsbench.raster.cpu import CpuRasterizer

        return CpuRasterizer(threads=threads)
    if resolved == "cuda":
        from gsbench.raster.cuda import CudaRasterizer

        return CudaRasterizer()
    from gsbench.raster.reference import ReferenceRasterizer

    return ReferenceRasterizer()


__all__ = ["CONSTANTS", "NAMES", "RasterConstants", "Rasterizer", "RenderOutput", "create_rasterizer", "resolve_name"]
