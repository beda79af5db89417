"""Counts of how often a program makes the host wait for a GPU, on any device, so that a test on a CPU can tell."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

from gsbench.raster.readback import Readback

# Operations whose result, or its size, the host has to know before it goes on.
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
MAKING = "lift_fresh"  # a tensor of Python numbers: an upload where it is for a device


@contextmanager
def counting_waits(pretend: bool = False) -> Iterator[Counter[str]]:
    """Count, by operation, what would make the host wait for a CUDA device within the block.

    That is reading a value, a size that depends on values (``nonzero``, an index that is a mask), a copy between device
    and host that is not asynchronous, and a `Readback` that has not arrived when it is asked for. With ``pretend``
    every tensor on the CPU counts as one on a device: what is made of Python numbers would be an upload.
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

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        name = function.overloadpacket.__name__
        result = function(*args, **kwargs)
        if (
            (name in WAITING and not (name == "repeat_interleave" and kwargs.get("output_size") is not None))
            or (name in INDEXING and any(_is_mask(index) for index in args[1]))
            or (name == MAKING and (self._pretend or result.device.type == "cuda"))
            or (name in COPYING and _crosses(args, result) and not _is_asynchronous(name, args, kwargs))
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
