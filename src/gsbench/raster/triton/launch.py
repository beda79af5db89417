"""Launches of Triton kernels, and pools of device memory for them."""

from __future__ import annotations

import weakref
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

# Fuse products and sums to fma. It is the default of Triton only before 3.10.
OPTIONS = {"enable_fp_fusion": True}

# Makes an output: name, shape, dtype.
Allocate = Callable[[str, tuple[int, ...], torch.dtype], Tensor]


def launch(kernel: Any, count: int, group: int) -> Callable[..., None]:
    """Return a launcher of ``kernel`` for ``count`` items, one per lane and ``group`` per program.

    It launches nothing if ``count`` is 0.
    """

    def run(**arguments: Any) -> None:
        if count:
            launch_grid(kernel, -(-count // group))(GROUP=group, **arguments)

    return run


def launch_grid(kernel: Any, *programs: int) -> Callable[..., None]:
    """Return a launcher of ``kernel`` on a grid of ``programs``, at least 1 on each axis.

    The launcher takes the kernel's arguments and constants, and options of Triton, for example
    ``num_warps``, all by name: a kernel has up to 25, and two that change places would be found
    late or never.
    """

    def run(**arguments: Any) -> None:
        kernel[programs](**OPTIONS, **arguments)

    return run


class Workspace:
    """Named 1D tensors that grow by doubling; until it grows, a tensor keeps its contents."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._buffers: dict[str, Tensor] = {}

    def take(self, name: str, count: int, dtype: torch.dtype) -> Tensor:
        """Return ``count`` numbers of ``dtype``. A name must always have the same dtype."""
        if name not in self._buffers or count > self.capacity(name):
            grown = max(count, 2 * self.capacity(name))
            # Free the old buffer first, so that both never exist at once.
            self._buffers.pop(name, None)
            # A tensor made in inference mode could not be written to outside that mode.
            with torch.inference_mode(False):
                self._buffers[name] = torch.empty(grown, dtype=dtype, device=self.device)
        return self._buffers[name][:count]

    def capacity(self, name: str) -> int:
        """The number of values that ``take`` returns without growing."""
        buffer = self._buffers.get(name)
        return 0 if buffer is None else len(buffer)


class WorkspacePool:
    """A pool of workspaces. A workspace returns to the pool when its ``holder`` is freed.

    It is leased again only for the same stream: work that still reads it is queued there, before
    the work of the next holder.
    """

    def __init__(self) -> None:
        self._free: defaultdict[tuple[torch.device, int], list[Workspace]] = defaultdict(list)

    def lease(self, holder: object, device: torch.device) -> Workspace:
        stream = torch.cuda.current_stream(device).cuda_stream if device.type == "cuda" else 0
        free = self._free[device, stream]
        try:
            workspace = free.pop()  # atomic, so threads need no lock
        except IndexError:
            workspace = Workspace(device)
        weakref.finalize(holder, free.append, workspace).atexit = False
        return workspace
