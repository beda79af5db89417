"""Timing of rasterizers: training steps in parts, whole training steps, frames as in a viewer."""

import itertools
import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch

from gsbench.bench.scenes import SEED, make_scene
from gsbench.densify import ADC
from gsbench.errors import InputError
from gsbench.gaussians.paper_values import RATES
from gsbench.logs import progress
from gsbench.pipeline.parts import build_own_rasterizer
from gsbench.raster import create_rasterizer
from gsbench.raster.executors import find_executor
from gsbench.system.isolate import run_isolated
from gsbench.system.resources import disable_tf32, peak_memory_mb, reset_peak_memory
from gsbench.train.options import TrainConfig
from gsbench.train.trainer import Trainer

WARM_UP_STEPS = 2  # they compile kernels and fill memory pools
SH_DEGREE = 3
NEVER = 10**9  # iterations
# Learning rate: Adam does its work, but the scene does not change. Not smaller: its products would
# fall below float32's normal range, where Intel processors need some 150 cycles per operation (at
# 1e-30 Adam took 35 ms for 6).
ZERO_RATE = 1e-20
# whole steps between two readings of the clock and of the losses
STEPS_AT_ONCE = {"cpu": 1, "cuda": 10}
UNUSED_FOLDER = Path("/nonexistent")  # for snapshots, which are off


@dataclass(frozen=True)
class Setting:
    """The scene, image size and threads of a measurement."""

    scene: str  # of `bench.scenes.SCENES`
    width: int  # px
    height: int  # px
    count: int  # Gaussians
    ply: Path | None = None  # instead of ``scene`` and ``count``
    threads: int | None = None  # None: torch's default

    @property
    def size(self) -> str:
        return f"{self.width}x{self.height}"


class Stepper:
    """A training of ``setting`` with ``raster``, an executor's name or a class's import path."""

    def __init__(self, raster: str, setting: Setting) -> None:
        self.threads = setting.threads or torch.get_num_threads()
        torch.set_num_threads(self.threads)
        self.device = device_of(raster)
        if self.device.type == "cuda":
            disable_tf32()
        gaussians, scene = make_scene(
            setting.scene, setting.width, setting.height, setting.count, setting.ply
        )
        self.count = len(gaussians)
        own = None
        if "." in raster:  # the user has typed the path of a class, and so trusts it
            own = build_own_rasterizer({"_target_": raster}, [raster.partition(".")[0]])
        self.trainer = Trainer(
            scene,
            gaussians.map(lambda tensor: tensor.detach().to(self.device)),
            ADC(start=NEVER - 1, stop=NEVER, opacity_reset_interval=NEVER, max_gaussians=None),
            own or create_rasterizer(raster, self.device, self.threads),
            constant_scene_options(),
            SEED,
        )
        self.trainer.step = SH_DEGREE  # sh_interval is 1, so the degree is full from here on

    def step(self) -> dict[str, float]:
        """Time one whole training step, then the parts of another, ms.

        The parts are made one after the other, as autograd makes them, and waited for; a training
        may fuse some of them.
        """
        trainer = self.trainer
        target = trainer.targets.get(0)
        cpu, begin = time.process_time(), self._now()
        trainer.iterate(UNUSED_FOLDER)
        trainer.losses.wait()
        whole, cpu = self._now() - begin, time.process_time() - cpu
        marks = [self._now()]
        image = trainer.render(0).image
        marks.append(self._now())
        loss = trainer.loss(image, target)[0]
        marks.append(self._now())
        loss.backward()
        marks.append(self._now())
        trainer.gaussians.optimizer_step()
        marks.append(self._now())
        parts = ("forward_ms", "loss_ms", "backward_ms", "adam_ms")
        times = [1e3 * (b - a) for a, b in itertools.pairwise(marks)]
        return {**dict(zip(parts, times, strict=True)), "step_ms": 1e3 * whole, "cpu_ms": 1e3 * cpu}

    def steps_per_second(self) -> float:
        """The speed of whole training steps.

        A step has view, render, loss, backward pass, statistics and Adam. Losses are read at times.
        """
        steps = STEPS_AT_ONCE[self.device.type]
        begin = self._now()
        for _ in range(steps):
            self.trainer.iterate(UNUSED_FOLDER)
        self.trainer.losses.wait()
        return steps / (self._now() - begin)

    def frames_per_second(self) -> float:
        """The speed of rendering one view as a viewer does: without gradients or other work."""
        frames = STEPS_AT_ONCE[self.device.type]
        begin = self._now()
        with torch.no_grad():
            for _ in range(frames):
                self.trainer.render(0)
        return frames / (self._now() - begin)

    def _now(self) -> float:
        if self.device.type == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter()


def device_of(raster: str) -> torch.device:
    """The device for timing ``raster``.

    It is a GPU if ``raster`` needs one, or if it is a user's class and there is a GPU. Raises
    InputError if it needs one and there is none.
    """
    if "." in raster:
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    device = torch.device("cpu" if find_executor(raster).runs_on("cpu") else "cuda")
    if device.type == "cuda" and not torch.cuda.is_available():
        raise InputError(f"raster={raster} runs on a CUDA device, and torch finds none here")
    return device


def constant_scene_options() -> TrainConfig:
    """Options of a training that does not end and does not change the Gaussians."""
    zero: dict[str, Any] = dict.fromkeys(RATES, ZERO_RATE)
    return TrainConfig(name="bench", iterations=NEVER, sh_interval=1, **zero)


def peak_memory(raster: str, setting: Setting) -> float:
    """Peak memory, MiB, of the warm-up steps and one more; call it in a fresh process."""
    stepper = Stepper(raster, setting)
    if stepper.device.type == "cuda":
        reset_peak_memory(stepper.device)
    for _ in range(WARM_UP_STEPS + 1):
        stepper.step()
    return peak_memory_mb(stepper.device)


def run_bench(
    rasters: Sequence[str],
    settings: Iterable[Setting],
    repeats: int,
    memory: bool = True,
) -> list[dict[str, Any]]:
    """Time the training step with each of ``rasters`` in each of ``settings``.

    The rasterizers take turns, step by step. Times are medians over ``repeats``, in ms. Raises
    InputError for a rasterizer that cannot run here. Columns:

    - ``step_ms``: a whole step, as a training makes it;
    - ``forward_ms`` (render), ``loss_ms``, ``backward_ms`` (of loss and render) and ``adam_ms``:
      its parts, made one after the other by autograd;
    - ``cpu_ms``: processor time of the step on all threads;
    - ``step_ratio``: median over the turns of ``step_ms`` divided by that of the first of
      ``rasters``;
    - ``steps_per_second``: whole training steps, without waits in between;
    - ``fps``: frames per second of rendering alone;
    - ``peak_memory_mb``: of a fresh process that makes the same steps (on a GPU: torch's
      allocations there); None if ``memory`` is False.
    """
    rows = []
    with progress("bench") as report:
        for setting in settings:
            model = f"{setting.count:,} Gaussians" if setting.ply is None else setting.ply.name
            say = partial(report, f"{setting.size}, {model}")
            own = _compare(rasters, setting, repeats, say)
            if memory:
                for row in own:
                    say(len(own), len(own), f"memory of {row['raster']}")
                    task = f"measuring the memory of raster={row['raster']}"
                    row["peak_memory_mb"] = run_isolated(
                        peak_memory, row["raster"], setting, what=task
                    )
            rows += own
    return rows


def _compare(
    rasters: Sequence[str],
    setting: Setting,
    repeats: int,
    say: Callable[[int, int, str], None],
) -> list[dict[str, Any]]:
    """The rows of one setting, without the memory."""
    steppers = {raster: Stepper(raster, setting) for raster in rasters}
    samples: dict[str, list[dict[str, float]]] = {raster: [] for raster in rasters}
    for turn in range(WARM_UP_STEPS + repeats):
        for raster, stepper in steppers.items():
            say(turn, WARM_UP_STEPS + repeats, raster)
            sample = stepper.step()
            samples[raster].append(sample)
            sample["step_ratio"] = sample["step_ms"] / samples[rasters[0]][turn]["step_ms"]
            sample["steps_per_second"] = stepper.steps_per_second()
            sample["fps"] = stepper.frames_per_second()
    rows = []
    for raster, stepper in steppers.items():
        counted = samples[raster][WARM_UP_STEPS:]
        row: dict[str, Any] = {
            "raster": raster,
            "scene": str(setting.ply or setting.scene),
            "size": setting.size,
            "count": stepper.count,
        }
        row |= {key: round(statistics.median(s[key] for s in counted), 3) for key in counted[0]}
        row |= {"threads": stepper.threads, "device": stepper.device.type, "peak_memory_mb": None}
        rows.append(row)
    return rows
