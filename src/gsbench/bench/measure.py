"""Rasterizers side by side: single steps in parts, and whole steps and frames as trainings and viewers make them."""

import itertools
import statistics
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from gsbench.bench.scenes import SEED, make_scene
from gsbench.densify import ADC
from gsbench.errors import InputError
from gsbench.logs import Progress, progress
from gsbench.pipeline.parts import build_rasterizer
from gsbench.raster.base import Rasterizer
from gsbench.raster.executors import find_executor
from gsbench.system.isolate import run_isolated
from gsbench.system.resources import peak_memory_mb, reset_peak_memory
from gsbench.train.device import disable_tf32
from gsbench.train.options import TrainConfig
from gsbench.train.trainer import Trainer

WARM_UP_STEPS = 2  # compile, and let memory pools grow
SH_DEGREE = 3
NEVER = 10**9  # iterations
STANDSTILL = 1e-30  # learning rates: the work of Adam on a scene that stays as it is
STEPS_AT_ONCE = {"cpu": 1, "cuda": 10}  # whole steps between two looks at the clock; losses are read as often
NOWHERE = Path("/nonexistent")  # a folder that is named and never used: no snapshot is asked for


@dataclass(frozen=True)
class Setting:
    """Conditions of a measurement."""

    scene: str  # of `bench.scenes.SCENES`
    width: int  # px
    height: int  # px
    count: int  # Gaussians
    ply: Path | None = None  # instead of ``scene`` and ``count``
    threads: int | None = None  # None: as many as torch takes


class Stepper:
    """A training of ``setting`` with the rasterizer called ``raster``: an executor, or an import path."""

    def __init__(self, raster: str, setting: Setting) -> None:
        self.threads = setting.threads or torch.get_num_threads()
        torch.set_num_threads(self.threads)
        self.device = device_of(raster)
        if self.device.type == "cuda":
            disable_tf32()
        gaussians, scene = make_scene(setting.scene, setting.width, setting.height, setting.count, setting.ply)
        self.count = len(gaussians)
        self.trainer = Trainer(
            scene,
            gaussians.map(lambda tensor: tensor.detach().to(self.device)),
            ADC(start=NEVER - 1, stop=NEVER, opacity_reset_interval=NEVER, max_gaussians=None),
            make_rasterizer(raster, self.device, self.threads),
            standing_still(),
            SEED,
        )
        self.trainer.step = SH_DEGREE  # with a new degree at every iteration

    def step(self) -> dict[str, float]:
        """One step as its parts, waiting for the device after each; ms."""
        trainer = self.trainer
        target = trainer.targets.get(0)
        cpu = time.process_time()
        marks = [self._now()]
        image = trainer.render(0).image
        marks.append(self._now())
        loss = trainer.loss(image, target)[0]
        marks.append(self._now())
        loss.backward()
        marks.append(self._now())
        trainer.gaussians.optimizer_step()
        marks.append(self._now())
        forward, loss_time, backward, adam = (1e3 * (b - a) for a, b in itertools.pairwise(marks))
        return {
            "forward_ms": forward,
            "backward_ms": backward,
            "step_ms": 1e3 * (marks[-1] - marks[0]),
            "loss_ms": loss_time,
            "adam_ms": adam,
            "cpu_ms": 1e3 * (time.process_time() - cpu),
        }

    def steps_per_second(self) -> float:
        """Whole training steps: the next view, render, loss, backward, statistics, Adam, losses read now and then."""
        steps = STEPS_AT_ONCE[self.device.type]
        begin = self._now()
        for _ in range(steps):
            self.trainer.iterate(NOWHERE)
        self.trainer.losses.wait()
        return steps / (self._now() - begin)

    def frames_per_second(self) -> float:
        """Renders of one view as a viewer makes them: no gradients, no other work between."""
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
    """The device on which ``raster`` is timed: a GPU if it needs one, or is a user's own class and there is one."""
    if "." in raster:
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    device = torch.device("cpu" if find_executor(raster).runs_on("cpu") else "cuda")
    if device.type == "cuda" and not torch.cuda.is_available():
        raise InputError(f"raster={raster} runs on a CUDA device, and torch finds none here")
    return device


def make_rasterizer(raster: str, device: torch.device, threads: int) -> Rasterizer:
    """The executor of that name, or the class at that import path: whoever types it here trusts it."""
    if "." in raster:
        return build_rasterizer({"_target_": raster}, [raster.partition(".")[0]], device, threads)
    return build_rasterizer({"name": raster}, [], device, threads)


def standing_still() -> TrainConfig:
    """Options of a training that neither ends nor changes the Gaussians."""
    rates = ("position_initial", "position_final", "sh_dc", "sh_rest", "opacity", "scale", "rotation")
    return TrainConfig(name="bench", iterations=NEVER, sh_interval=1, **dict.fromkeys(rates, STANDSTILL))  # type: ignore[arg-type]


def peak_memory(raster: str, setting: Setting) -> float:
    """Peak memory, MiB, of the warm-up steps and one more; for a process of its own."""
    stepper = Stepper(raster, setting)
    if stepper.device.type == "cuda":
        reset_peak_memory(stepper.device)
    for _ in range(WARM_UP_STEPS + 1):
        stepper.step()
    return peak_memory_mb(stepper.device)


def run_bench(
    rasters: list[str],
    sizes: list[tuple[int, int]],
    counts: list[int],
    ply: Path | None = None,
    repeats: int = 5,
    threads: int | None = None,
    memory: bool = True,
    scene: str = "trained",
) -> list[dict[str, Any]]:
    """Time the training step with each of ``rasters`` for each image size (width, height) and count of Gaussians.

    The rasters take turns, step by step; all times are medians over ``repeats``, in ms. ``forward_ms`` is the render,
    ``backward_ms`` the backward pass of loss and render, ``step_ms`` everything; ``loss_ms`` and ``adam_ms`` are the
    rest, and ``cpu_ms`` is the processor time of the step on all threads. ``step_ratio`` is the median of the turns'
    quotients with the first of ``rasters``. ``steps_per_second`` is that of whole training steps, which nothing is
    waited for in between; ``fps`` is frames a second, rendered alone. ``peak_memory_mb`` is that of a fresh process
    that makes the same steps (on a GPU: of torch's allocations there), None if ``memory`` is false. With ``ply`` that
    model is timed, not ``counts``. Raises InputError for a raster that cannot run here.
    """
    rows = []
    with progress("bench") as report:
        for width, height in sizes:
            for count in counts if ply is None else [0]:
                setting = Setting(scene, width, height, count, ply, threads)
                rows += _compare(rasters, setting, repeats, memory, report)
    return rows


def _compare(
    rasters: list[str], setting: Setting, repeats: int, memory: bool, report: Progress
) -> list[dict[str, Any]]:
    model = f"{setting.count:,} Gaussians" if setting.ply is None else setting.ply.name
    what, turns = f"{setting.width}x{setting.height}, {model}", WARM_UP_STEPS + repeats
    steppers = {raster: Stepper(raster, setting) for raster in rasters}
    parts: dict[str, list[dict[str, float]]] = {raster: [] for raster in rasters}
    speeds: dict[str, list[float]] = {raster: [] for raster in rasters}
    frames: dict[str, list[float]] = {raster: [] for raster in rasters}
    for repeat in range(turns):
        for raster, stepper in steppers.items():
            report(what, repeat, turns, raster)
            sample, speed, fps = stepper.step(), stepper.steps_per_second(), stepper.frames_per_second()
            if repeat >= WARM_UP_STEPS:
                parts[raster].append(sample)
                frames[raster].append(fps)
                speeds[raster].append(speed)
    rows = []
    for raster, stepper in steppers.items():
        pairs = zip(parts[raster], parts[rasters[0]], strict=True)
        row: dict[str, Any] = {
            "raster": raster,
            "scene": setting.scene if setting.ply is None else str(setting.ply),
            "size": f"{setting.width}x{setting.height}",
            "count": stepper.count,
        }
        row |= {key: _median([sample[key] for sample in parts[raster]]) for key in parts[raster][0]}
        row |= {
            "step_ratio": _median([own["step_ms"] / first["step_ms"] for own, first in pairs]),
            "steps_per_second": _median(speeds[raster]),
            "fps": _median(frames[raster]),
            "threads": stepper.threads,
            "device": stepper.device.type,
        }
        rows.append(row)
    del steppers, stepper  # their memory: the processes below need it
    for row in rows:
        row["peak_memory_mb"] = None
        if memory:
            report(f"{what}, memory", len(rows), len(rows), row["raster"])
            row["peak_memory_mb"] = _measure_memory(row["raster"], setting)
    return rows


def _measure_memory(raster: str, setting: Setting) -> float:
    ply = None if setting.ply is None else setting.ply.absolute()
    return run_isolated(peak_memory, raster, replace(setting, ply=ply), what=f"measuring the memory of raster={raster}")


def _median(values: list[float]) -> float:
    return round(statistics.median(values), 3)
