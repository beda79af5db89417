"""Start of the kernels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


def launch(kernel: Any, count: int, group: int) -> Callable[..., None]:
    """``kernel`` for ``count`` items, a lane an item and ``group`` a program; nothing at all for no items."""

    def run(*arguments: Any, **constants: Any) -> None:
        if count:
            kernel[(-(-count // group),)](*arguments, GROUP=group, **constants)

    return run
