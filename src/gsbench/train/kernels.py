"""The kernels of a training on the CPU, compiled in a thread before it begins."""

import logging
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

from gsbench.raster import Rasterizer
from gsbench.system.resources import CLOCK

log = logging.getLogger(__name__)


def kernels_of(rasterizer: Rasterizer) -> list[tuple[Any, Any]]:
    """Each kernel that all trainings on the CPU with ``rasterizer`` call, and its arguments' types.

    Kernels for outputs that few densifiers request are compiled at their first call.
    """
    from gsbench.raster.cpu import CpuRasterizer
    from gsbench.raster.cpu.signatures import KERNELS
    from gsbench.train.loss_cpu import KERNELS as LOSS_KERNELS

    return [*(KERNELS if isinstance(rasterizer, CpuRasterizer) else ()), *LOSS_KERNELS]


@contextmanager
def compiled_beside(rasterizer: Rasterizer, wanted: bool) -> Iterator[Callable[[], None]]:
    """Compile `kernels_of` in a thread, if ``wanted``; yield a function that waits for it.

    The stages before a training mostly wait for processes of their own. If the block ends early,
    the kernel that is being compiled is the last.
    """
    kernels, earlier = kernels_of(rasterizer) if wanted else [], CLOCK.seconds
    with ThreadPoolExecutor(1, thread_name_prefix="gsbench-compile") as pool:
        jobs = [pool.submit(kernel.compile, signature) for kernel, signature in kernels]

        def wait() -> None:
            for job in jobs:
                job.result()
            if (seconds := CLOCK.seconds - earlier) > 1:
                log.info("kernels: compiled in %.0f s, and kept for later trials", seconds)

        try:
            yield wait
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
