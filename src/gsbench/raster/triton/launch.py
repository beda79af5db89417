"""Launches of Triton kernels, and the device memory that they use again."""

from __future__ import annotations

import weakref
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

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


class Workspace:
    """Named one-dimensional tensors that grow by doubling. ``take`` gives a view with what was left there."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._buffers: dict[str, Tensor] = {}

    def take(self, name: str, count: int, dtype: torch.dtype) -> Tensor:
        """``count`` numbers of ``dtype``; one name always has one dtype."""
        if count > self.capacity(name):
            grown = max(count, 2 * self.capacity(name))
            self._buffers.pop(name, None)  # before the new one is made
            with torch.inference_mode(False):  # it will be written to in other modes
                self._buffers[name] = torch.empty(grown, dtype=dtype, device=self.device)
        elif name not in self._buffers:
            return torch.empty(0, dtype=dtype, device=self.device)
        return self._buffers[name][:count]

    def capacity(self, name: str) -> int:
        """The number of values that ``take`` gives without growing."""
        buffer = self._buffers.get(name)
        return 0 if buffer is None else len(buffer)


class WorkspacePool:
    """Workspaces that outlive the graph of a render: one comes back when its ``holder`` is freed.

    One that comes back is given only to work on the same stream, which waits for what still reads it.
    """

    def __init__(self) -> None:
        self._free: defaultdict[tuple[torch.device, int], list[Workspace]] = defaultdict(list)

    def lease(self, holder: object, device: torch.device) -> Workspace:
        stream = torch.cuda.current_stream(device).cuda_stream if device.type == "cuda" else 0
        free = self._free[device, stream]
        try:
            workspace = free.pop()  # atomic
        except IndexError:
            workspace = Workspace(device)
        weakref.finalize(holder, free.append, workspace).atexit = False
        return workspace
