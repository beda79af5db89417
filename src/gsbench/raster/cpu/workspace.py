"""Pools that reuse memory, and threads that run the shards of a stage.

Page faults of newly allocated arrays would take longer than the kernels that fill the arrays.
"""

import threading
import weakref
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from itertools import pairwise
from math import prod
from typing import Any

import numpy as np
import torch
from numpy.typing import DTypeLike, NDArray
from torch import Tensor

RANGES_PER_THREAD = 2  # so that a thread that is done early takes another
HEADROOM = 1.25  # times the requested size, so that a growing scene does not allocate at every step


def aligned_bytes(size: int) -> NDArray[np.uint8]:
    """``size`` uninitialised bytes that start on a cache line, as all memory of torch does."""
    return torch.empty(size, dtype=torch.uint8).numpy()


class Arena:
    """Named scratch arrays that only grow; until it grows, an array keeps its contents."""

    def __init__(self) -> None:
        self._blocks: dict[str, NDArray[np.uint8]] = {}

    def take(
        self, name: str, shape: tuple[int, ...], dtype: DTypeLike, zero: bool = False
    ) -> NDArray[Any]:
        """Return the array ``name`` with this shape.

        With ``zero``, it is set to 0 only if its memory is newly allocated.
        """
        size = prod(shape) * np.dtype(dtype).itemsize
        block = self._blocks.get(name)
        if block is None or block.size < size:
            # Free the old block first, so that both never exist at once.
            self._blocks.pop(name, None)
            del block
            block = aligned_bytes(int(size * HEADROOM))
            if zero:
                block[:] = 0
            self._blocks[name] = block
        return block[:size].view(dtype).reshape(shape)

    def drop(self, name: str) -> None:
        """Discard an array whose contents are not reliable."""
        self._blocks.pop(name, None)


class ArenaPool:
    """A pool of arenas. An arena returns to the pool when its ``holder`` is garbage-collected."""

    def __init__(self) -> None:
        self._free: list[Arena] = []

    def lease(self, holder: object) -> Arena:
        try:
            arena = self._free.pop()  # atomic, so threads need no lock
        except IndexError:
            arena = Arena()
        weakref.finalize(holder, self._free.append, arena).atexit = False
        return arena


class TensorPool:
    """A pool of memory for float32 tensors.

    Memory returns to it when torch frees the last tensor that uses it.
    """

    def __init__(self) -> None:
        self._free: list[NDArray[np.uint8]] = []
        self._lock = threading.Lock()

    def empty(self, shape: tuple[int, ...]) -> Tensor:
        """An uninitialised tensor of ``shape``."""
        size = prod(shape) * 4
        block = self._pop(size)
        array = block[:size].view(np.float32).reshape(shape)
        weakref.finalize(array, self._free.append, block).atexit = False
        return torch.from_numpy(array)

    def _pop(self, size: int) -> NDArray[np.uint8]:
        with self._lock:
            fitting = [
                k for k, block in enumerate(self._free) if size <= block.size <= 2 * size + 4096
            ]
            if fitting:
                return self._free.pop(min(fitting, key=lambda k: self._free[k].size))
            # Drop the block that was unused for longest, so that the pool never has more blocks
            # than were in use at once.
            if self._free:
                self._free.pop(0)
        return aligned_bytes(int(size * HEADROOM))


class ShardRunner:
    """Runs the shards of a stage on ``threads`` threads, of which the caller's is one.

    The result of a shard must not depend on the thread. Shards are run in few ranges, because each
    call of a kernel costs up to 40 microseconds, in which no other thread runs Python.
    """

    def __init__(self, threads: int) -> None:
        self.threads = threads
        self._helpers = (
            ThreadPoolExecutor(threads - 1, thread_name_prefix="gsbench-raster")
            if threads > 1
            else None
        )

    def run(self, shards: int, work: Callable[..., None], *arguments: Any) -> None:
        """Call ``work(first, past, *arguments)`` for ranges of shards until all have run.

        On an error or an interrupt, wait for the calls that have begun.
        """
        if self._helpers is None:
            work(0, shards, *arguments)
            return
        parts = min(shards, RANGES_PER_THREAD * self.threads)
        edges = [shards * part // parts for part in range(parts + 1)]
        ranges = iter([*pairwise(edges)])  # each is taken by the first thread that is free

        def run_ranges() -> None:
            try:
                for first, past in ranges:
                    work(first, past, *arguments)
            finally:
                for _ in ranges:  # only after an error: no further range begins
                    pass

        futures = [self._helpers.submit(run_ranges) for _ in range(self.threads - 1)]
        try:
            run_ranges()
        finally:
            begun = [future for future in futures if not future.cancel()]
            wait(begun)  # no thread may still write to memory that returns to a pool
        for future in begun:
            future.result()
