"""Memory that is used again: fresh arrays of this size cost more in page faults than the kernels that fill them."""

import threading
import weakref
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from math import prod
from typing import Any

import numpy as np
import torch
from numpy.typing import DTypeLike, NDArray
from torch import Tensor

CACHE_LINE = 64  # bytes
HEADROOM = 1.25  # of a request, so that a scene that grows does not allocate at every step


def aligned_bytes(size: int) -> NDArray[np.uint8]:
    """``size`` uninitialised bytes that start on a cache line."""
    raw = np.empty(size + CACHE_LINE, np.uint8)
    offset = -raw.ctypes.data % CACHE_LINE
    return raw[offset : offset + size]


class Arena:
    """Named scratch arrays that only grow. ``take`` gives a view; its content is what the last user left."""

    def __init__(self) -> None:
        self._blocks: dict[str, NDArray[np.uint8]] = {}

    def take(self, name: str, shape: tuple[int, ...], dtype: DTypeLike, zero: bool = False) -> NDArray[Any]:
        """An array of ``shape``; ``zero`` clears it whenever it had to be allocated anew."""
        size = prod(shape) * np.dtype(dtype).itemsize
        block = self._blocks.get(name)
        if block is None or block.size < size:
            self._blocks.pop(name, None)
            del block
            block = aligned_bytes(int(size * HEADROOM))
            if zero:
                block[:] = 0
            self._blocks[name] = block
        return block[:size].view(dtype).reshape(shape)

    def drop(self, name: str) -> None:
        """Forget an array whose content cannot be trusted."""
        self._blocks.pop(name, None)


class ArenaPool:
    """Arenas that outlive the graph of a render: an arena comes back when its ``holder`` is collected."""

    def __init__(self) -> None:
        self._free: list[Arena] = []

    def lease(self, holder: object) -> Arena:
        try:
            arena = self._free.pop()  # atomic
        except IndexError:
            arena = Arena()
        weakref.finalize(holder, self._free.append, arena).atexit = False
        return arena


class TensorPool:
    """float32 tensors whose memory comes back to the pool when torch has freed the last tensor on it."""

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
            fitting = [k for k, block in enumerate(self._free) if size <= block.size <= 2 * size + 4096]
            if fitting:
                return self._free.pop(min(fitting, key=lambda k: self._free[k].size))
            if self._free:
                self._free.pop(0)  # the one unused for longest: the pool keeps no more blocks than were ever in use
        return aligned_bytes(int(size * HEADROOM))


class ShardRunner:
    """Runs the shards of a stage on ``threads`` threads. What a shard computes must not depend on who runs it.

    A single thread gets all of them in one call: to hand a kernel its arguments takes up to 40 microseconds.
    """

    def __init__(self, threads: int) -> None:
        self.threads = threads
        self._executor = ThreadPoolExecutor(threads, thread_name_prefix="gsbench-raster") if threads > 1 else None

    def run(self, shards: int, work: Callable[[int, int], None]) -> None:
        """Call ``work(first, past)`` for ranges of shards until all were run; on an error or an interrupt, wait for
        what was begun."""
        if self._executor is None:
            work(0, shards)
            return
        futures = [self._executor.submit(work, shard, shard + 1) for shard in range(shards)]
        try:
            for future in futures:
                future.result()
        finally:
            for future in futures:
                future.cancel()
            wait(futures)  # nobody may write to memory that is about to be used again
