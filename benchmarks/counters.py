"""For work on speed: the time of a step by kernel, and its number of waits for a GPU."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

from gsbench.raster.staged import Readback

OWN_CODE = "gsbench."
# Operations whose result, or its size, the host must know before it continues.
WAITING = frozenset(
    {
        "_local_scalar_dense",
        "_unique",
        "_unique2",
        "bincount",
        "equal",
        "is_nonzero",
        "masked_select",
        "nonzero",
        "repeat_interleave",
        "unique_consecutive",
        "unique_dim",
    }
)
INDEXING = frozenset({"index", "index_put", "index_put_", "_index_put_impl_", "_unsafe_index"})
COPYING = frozenset({"_to_copy", "copy_"})
MAKING = "lift_fresh"  # a tensor of Python numbers: an upload if it is for a device


@contextmanager
def timed_kernels() -> Iterator[Counter[str]]:
    """Measure the processor time, ms, of each compiled kernel within the block, over all threads.

    Until the block ends, every kernel in a module of gsbench is replaced by one that is timed.
    """
    times: Counter[str] = Counter()
    replaced: list[tuple[dict[str, Any], str, Any]] = []
    for module, contents in [
        (name, vars(found)) for name, found in sys.modules.items() if found is not None
    ]:
        if not module.startswith(OWN_CODE):
            continue
        for name, value in list(contents.items()):
            if type(value).__module__.startswith("numba.") and hasattr(value, "py_func"):
                replaced.append((contents, name, value))
                contents[name] = _timed_call(value, times)
    try:
        yield times
    finally:
        for contents, name, value in replaced:
            contents[name] = value


def _timed_call(kernel: Any, times: Counter[str]) -> Callable[..., Any]:
    def call(*arguments: Any, **options: Any) -> Any:
        begin = time.thread_time()
        try:
            return kernel(*arguments, **options)
        finally:
            times[kernel.py_func.__name__] += 1e3 * (time.thread_time() - begin)  # type: ignore[assignment]

    return call


@contextmanager
def counting_waits(pretend: bool = False) -> Iterator[Counter[str]]:
    """Count the operations within the block that would make the host wait for a CUDA device.

    These read a value, need a size that depends on values (``nonzero``, an index that is a mask),
    copy between device and host synchronously, or ask for a `Readback` that has not arrived. With
    ``pretend``, every tensor on the CPU counts as one on a device, so that a tensor of Python
    numbers is an upload.
    """
    counts: Counter[str] = Counter()
    before = Readback.waits
    with _CountingMode(counts, pretend):
        yield counts
    if Readback.waits > before:
        counts["readback"] += Readback.waits - before


class _CountingMode(TorchDispatchMode):
    def __init__(self, counts: Counter[str], pretend: bool) -> None:
        super().__init__()
        self._counts = counts
        self._pretend = pretend

    def __torch_dispatch__(
        self, function: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        kwargs = kwargs or {}
        name = function.overloadpacket.__name__
        result = function(*args, **kwargs)
        if (
            (
                name in WAITING
                and not (name == "repeat_interleave" and kwargs.get("output_size") is not None)
            )
            or (name in INDEXING and any(_is_mask(index) for index in args[1]))
            or (name == MAKING and (self._pretend or result.device.type == "cuda"))
            or (
                name in COPYING
                and _crosses(args, result)
                and not _is_asynchronous(name, args, kwargs)
            )
        ):
            self._counts[name] += 1
        return result


def _is_mask(index: Any) -> bool:
    return isinstance(index, torch.Tensor) and index.dtype in (torch.bool, torch.uint8)


def _crosses(args: Any, result: Any) -> bool:
    """Return whether a copy goes from one type of device to another."""
    types = {tensor.device.type for tensor in (*args, result) if isinstance(tensor, torch.Tensor)}
    return len(types) > 1


def _is_asynchronous(name: str, args: Any, kwargs: Any) -> bool:
    if kwargs.get("non_blocking"):
        return True
    return name == "copy_" and len(args) > 2 and bool(args[2])
