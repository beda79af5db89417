"""The kernels of a training on the CPU, compiled in a thread before it begins."""

import logging
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import torch
from torch import Tensor

from gsbench.gaussians.paper_values import LearningRates
from gsbench.gaussians.trainable import TrainableGaussians
from gsbench.raster import Rasterizer
from gsbench.raster.contract import Case
from gsbench.system.resources import CLOCK
from gsbench.train.loss import PhotometricLoss

log = logging.getLogger(__name__)

CASE = Case(7, 5, 20, sh_degree=3)


def tiny_step(rasterizer: Rasterizer) -> Iterator[None]:
    """A training step, which calls the kernels that all trainings on the CPU with it call.

    Kernels for outputs that few densifiers request are compiled at their first call.
    """
    from gsbench.raster.cpu import CpuRasterizer
    from gsbench.train.adam_cpu import CpuAdam

    initial = CASE.gaussians().map(Tensor.float)
    model = TrainableGaussians(initial, LearningRates(), 1.0, CpuAdam(1))
    image = torch.zeros(CASE.height, CASE.width, 3, requires_grad=True)
    loss, target = PhotometricLoss(threads=1), torch.zeros_like(image, dtype=torch.uint8)
    yield
    loss(image, target)[0].backward()
    yield
    if isinstance(rasterizer, CpuRasterizer):
        own = CpuRasterizer(threads=1)
        image = own.render(model.values, CASE.camera(), CASE.sh_degree, torch.zeros(3)).image
        yield
        image.sum().backward()
        yield
        model.optimizer_step()


@contextmanager
def compiled_beside(rasterizer: Rasterizer, wanted: bool) -> Iterator[Callable[[], None]]:
    """Compile the kernels in a thread, if ``wanted``; yield a function that waits for it.

    The stages before a training mostly wait for processes of their own. If the block ends early,
    the part of `tiny_step` that is running is the last.
    """
    earlier, ended = CLOCK.seconds, threading.Event()

    def work() -> None:
        for _ in tiny_step(rasterizer):
            if ended.is_set():
                return

    with ThreadPoolExecutor(1, thread_name_prefix="gsbench-compile") as pool:
        job = pool.submit(work) if wanted else None

        def wait() -> None:
            if job is not None:
                job.result()
            if (seconds := CLOCK.seconds - earlier) > 1:
                log.info("kernels: compiled in %.0f s, and kept for later trials", seconds)

        try:
            yield wait
        finally:
            ended.set()
