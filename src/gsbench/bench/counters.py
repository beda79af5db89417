"""Parts of a step: its time by kernel, and how often it makes the host wait for a GPU (on any device)."""

from __future__ import annotations

import re
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

from gsbench.raster.readback import Readback

OWN_CODE = "gsbench."
REST = "(rest)"  # of the step's time: on a CPU what is no kernel of ours, on a GPU what no kernel ran in
MAX_NAME = 60
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
def timed_kernels(device_type: str) -> Iterator[Counter[str]]:
    """Time by kernel within the block, ms: of a GPU all that run on it, of a CPU the compiled ones of gsbench.

    On a CPU it is processor time, of all threads together; in Triton's interpreter that of its NumPy.
    """
    times: Counter[str] = Counter()
    with _profiled(times) if device_type == "cuda" else _wrapped(times):
        yield times


def short_name(kernel: str) -> str:
    """A kernel's name without what templates make of it."""
    name = re.sub(r"^(void|bool|int)\s+", "", kernel)
    while (plain := re.sub(r"<[^<>]*>", "", name)) != name:
        name = plain
    name = re.sub(r"\(anonymous namespace\)::", "", name).split("(")[0]
    return name.split("<")[0].rsplit("::", 1)[-1].strip()[:MAX_NAME] or kernel[:MAX_NAME]


@contextmanager
def _profiled(times: Counter[str]) -> Iterator[None]:
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        yield
        torch.cuda.synchronize()
    for event in profile.events() or ():
        # A range that a program names, such as an optimiser's step, lies over kernels that count themselves.
        if event.device_type.name == "CUDA" and not getattr(event, "is_user_annotation", False):
            times[short_name(event.name)] += event.time_range.elapsed_us() / 1e3


@contextmanager
def _wrapped(times: Counter[str]) -> Iterator[None]:
    """Every kernel that a module of gsbench has a name for is replaced by one that is timed, until the block ends."""
    replaced: list[tuple[dict[str, Any], str, Any]] = []
    stand_ins: dict[int, Any] = {}
    for module, contents in [(name, vars(found)) for name, found in sys.modules.items() if found is not None]:
        if not module.startswith(OWN_CODE):
            continue
        for name, value in list(contents.items()):
            make = _stand_in_of(value)
            if make is not None:
                stand_in = stand_ins.setdefault(id(value), make(value, times))
                replaced.append((contents, name, value))
                contents[name] = stand_in
    try:
        yield
    finally:
        for contents, name, value in replaced:
            contents[name] = value


def _stand_in_of(value: Any) -> Callable[[Any, Counter[str]], Any] | None:
    """Say how to time ``value``; None if it is no kernel."""
    origin = type(value).__module__
    if origin.startswith("numba.") and hasattr(value, "py_func"):
        return _timed_call
    if origin.startswith("triton.") and hasattr(value, "fn") and hasattr(value, "__getitem__"):
        return _TimedGrid
    return None


def _timed_call(kernel: Any, times: Counter[str]) -> Callable[..., Any]:
    def call(*arguments: Any, **options: Any) -> Any:
        begin = time.thread_time()
        try:
            return kernel(*arguments, **options)
        finally:
            times[kernel.py_func.__name__] += 1e3 * (time.thread_time() - begin)  # type: ignore[assignment]

    return call


class _TimedGrid:
    """A Triton kernel: it is given a grid, and then called. What other kernels call is theirs."""

    def __init__(self, kernel: Any, times: Counter[str]) -> None:
        self._kernel, self._times = kernel, times

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        return self._kernel(*arguments, **options)

    def __getitem__(self, grid: Any) -> Callable[..., Any]:
        launch = self._kernel[grid]

        def call(*arguments: Any, **options: Any) -> Any:
            begin = time.thread_time()
            try:
                return launch(*arguments, **options)
            finally:
                self._times[self._kernel.fn.__name__] += 1e3 * (time.thread_time() - begin)  # type: ignore[assignment]

        return call


def stages_of_a_step(step: Callable[[], Mapping[str, float]], device_type: str, repeats: int) -> dict[str, float]:
    """Mean ms a step by kernel, the longest first, and the rest of the step's time."""
    whole = 0.0
    with timed_kernels(device_type) as times:
        for _ in range(repeats):
            sample = step()
            whole += sample["step_ms"] if device_type == "cuda" else sample["cpu_ms"]
    mean = {name: round(total / repeats, 4) for name, total in times.most_common()}
    return mean | {REST: round((whole - sum(times.values())) / repeats, 4)}


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
