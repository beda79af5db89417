"""Start of the kernels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

# Products and sums are contracted to fma: Triton's default today, but no longer from 3.10 on.
OPTIONS = {"enable_fp_fusion": True}


def launch(kernel: Any, count: int, group: int) -> Callable[..., None]:
    """``kernel`` for ``count`` items, a lane an item and ``group`` a program; nothing at all for no items."""

    def run(*arguments: Any, **constants: Any) -> None:
        if count:
            launch_grid(kernel, -(-count // group))(*arguments, GROUP=group, **constants)

    return run


def launch_grid(kernel: Any, *programs: int) -> Callable[..., None]:
    """``kernel`` for a grid of ``programs``, at least one along each axis; ``num_warps`` is named beside constants."""

    def run(*arguments: Any, **constants: Any) -> None:
        kernel[programs](*arguments, **OPTIONS, **constants)

    return run
