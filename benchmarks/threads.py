"""A training step of ``raster=cpu`` on several threads: measured, and simulated for more of them.

    python -m benchmarks.threads [TRIAL WIDTH] ...

A trial is a folder with a trained model; one of its training views is drawn, ``WIDTH`` px wide.
Without a trial, the scene of `gsbench bench` is drawn.

On as many threads as this machine has, whole steps are measured by the clock, in turns: run it
while nothing else runs. For the simulation, every shard is timed on one thread, by processor time;
the fastest of some steps counts. Then the shards of a stage go to the threads in their order, each
to the first thread that is free, and all else is serial. Effects of threads on each other (memory,
caches, scheduling) are left out, so simulated speedups are upper bounds.
"""

from __future__ import annotations

import heapq
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch

from gsbench.bench.measure import NEVER, SH_DEGREE, UNUSED_FOLDER, constant_scene_options
from gsbench.bench.scenes import make_scene
from gsbench.densify import ADC
from gsbench.gaussians.model import Gaussians
from gsbench.gaussians.ply import read_ply
from gsbench.pipeline.parts import Parts
from gsbench.pipeline.trial import TrialSteps
from gsbench.raster.cpu import CpuRasterizer, executor
from gsbench.raster.cpu.workspace import ShardRunner
from gsbench.runs.keys import TRAIN
from gsbench.runs.layout import POINT_CLOUD, STORE
from gsbench.runs.store import Store
from gsbench.runs.trial_folder import TrialFolder
from gsbench.scene.types import Scene, View
from gsbench.system.resources import available_cores
from gsbench.train.trainer import Trainer

THREADS = (2, 4, 8, 16)
TILE_SHARDS = (8, 16, 32)
STEPS = 9
TURNS = 25


def trained(folder: Path, width: int) -> tuple[Gaussians, Scene]:
    """A trial's model, and its first training view, ``width`` px wide, with noise as photograph."""
    values = TrialFolder(folder).configuration()
    steps = TrialSteps(Parts(values), Store(Path(values["runs"]) / STORE))
    next(step for step in steps.steps() if step.stage == TRAIN)  # the views are known from here on
    camera = steps.views.scene.train[0].camera
    camera = camera.resized(width, round(camera.height * width / camera.width))
    image = np.random.default_rng(0).integers(
        0, 256, (camera.height, camera.width, 3), dtype=np.uint8
    )
    return read_ply(folder / POINT_CLOUD), Scene("bench", (View("0.png", camera, image),), ())


class Training:
    """A training on ``threads`` threads whose Gaussians do not change."""

    def __init__(self, gaussians: Gaussians, scene: Scene, threads: int) -> None:
        self.threads = threads
        torch.set_num_threads(threads)
        densifier = ADC(
            start=NEVER - 1, stop=NEVER, opacity_reset_interval=NEVER, max_gaussians=None
        )
        self.trainer = Trainer(
            scene, gaussians, densifier, CpuRasterizer(threads), constant_scene_options(), 0
        )
        self.trainer.step = SH_DEGREE

    def step(self, clock: Callable[[], float] = time.perf_counter) -> float:
        """Make a step; return its ms by ``clock``."""
        torch.set_num_threads(self.threads)
        begin = clock()
        self.trainer.iterate(UNUSED_FOLDER)
        self.trainer.losses.wait()
        return 1e3 * (clock() - begin)

    def stages(self) -> tuple[list[tuple[str, list[float]]], float]:
        """The stages of a step, with the ms of each shard, and the ms of all else."""
        stages: list[tuple[str, list[float]]] = []

        def timed(
            runner: ShardRunner, shards: int, work: Callable[..., None], *arguments: Any
        ) -> None:
            times = []
            for shard in range(shards):
                begin = time.process_time()
                work(shard, shard + 1, *arguments)
                times.append(1e3 * (time.process_time() - begin))
            stages.append((work.py_func.__name__, times))  # type: ignore[attr-defined]

        with mock.patch.object(ShardRunner, "run", timed):
            whole = self.step(time.process_time)
        return stages, whole - sum(sum(times) for _, times in stages)


def measure(title: str, gaussians: Gaussians, scene: Scene) -> None:
    """Print the measured times of a step by number of threads: medians over turns."""
    cores = available_cores()
    trainings = [Training(gaussians, scene, n) for n in (1, *THREADS) if n <= cores]
    turns = [[training.step() for training in trainings] for _ in range(2 + TURNS)][2:]
    one, *_ = medians = np.median(turns, axis=0)
    print(f"\n{title}, {len(gaussians):,} Gaussians, measured")
    for training, ms in zip(trainings, medians, strict=True):
        print(f"  {training.threads:2} threads: {ms:5.1f} ms, {one / ms:4.2f}x")


def makespan(times: Sequence[float], threads: int) -> float:
    """The time until the last shard ends, if each goes to the first thread that is free."""
    free = [0.0] * threads
    for ms in times:
        heapq.heapreplace(free, free[0] + ms)
    return max(free)


def simulate(title: str, gaussians: Gaussians, scene: Scene) -> None:
    """Print the simulated times of a step, by number of threads and of shards of tiles."""
    for shards in TILE_SHARDS:
        with mock.patch.object(executor, "TILE_SHARDS", shards):
            training = Training(gaussians, scene, 1)
            steps = [training.stages() for _ in range(2 + STEPS)][2:]
        names = [name for name, _ in steps[0][0]]
        fastest = [
            np.min([stages[k][1] for stages, _ in steps], axis=0).tolist()
            for k in range(len(names))
        ]
        serial = float(np.median([rest for _, rest in steps]))
        one = sum(map(sum, fastest)) + serial
        if shards == TILE_SHARDS[0]:
            camera = scene.train[0].camera
            print(
                f"\n{title}, {len(gaussians):,} Gaussians, {camera.width}x{camera.height}: "
                f"{one:.1f} ms on a thread, of which serial {serial:.1f}"
            )
            for name, times in zip(names, fastest, strict=True):
                mean = sum(times) / len(times)
                spans = "  ".join(f"{makespan(times, threads):6.2f}" for threads in THREADS)
                skew = f"longest/mean {max(times) / mean:4.2f}"
                print(f"  {name:<18} {sum(times):6.2f} ms in {len(times):2}, {skew}: {spans}")
        speedups = []
        for threads in THREADS:
            ms = sum(makespan(times, threads) for times in fastest) + serial
            speedups.append(f"{threads}: {one / ms:4.2f}x")
        print(f"  {shards:2} shards of tiles: {one:5.1f} ms on a thread; {'  '.join(speedups)}")


if __name__ == "__main__":
    asked = sys.argv[1:]
    scenes = [
        (folder, *trained(Path(folder), int(width)))
        for folder, width in zip(asked[::2], asked[1::2], strict=True)
    ]
    for scene in scenes or [("gsbench bench", *make_scene("trained", 500, 375, 100_000))]:
        measure(*scene)
        simulate(*scene)
