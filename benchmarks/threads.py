"""A simulation of a training step of ``raster=cpu`` on more threads than this machine has.

    python -m benchmarks.threads [TRIAL WIDTH] ...

A trial is a folder with a trained model; one of its training views is drawn, ``WIDTH`` px wide.
Without a trial, the scene of `gsbench bench` is drawn. Every shard is timed on one thread, by
processor time; the fastest of some steps counts. Then the shards of a stage go to the threads in
their order, each to the first thread that is free. torch's Adam is divided evenly, and all else is
serial. Effects of threads on each other (memory, caches, scheduling) are left out, so speedups are
upper bounds.
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

from gsbench.bench.measure import NEVER, SH_DEGREE, constant_scene_options
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
from gsbench.train.trainer import Trainer

THREADS = (2, 4, 8, 16)
TILE_SHARDS = (8, 16, 32)
STEPS = 9


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


class Timed:
    """A training on one thread.

    ``stages`` are the stages of the last step in order: the name, and the ms of each shard.
    """

    def __init__(self, gaussians: Gaussians, scene: Scene) -> None:
        densifier = ADC(
            start=NEVER - 1, stop=NEVER, opacity_reset_interval=NEVER, max_gaussians=None
        )
        self.trainer = Trainer(
            scene, gaussians, densifier, CpuRasterizer(threads=1), constant_scene_options(), 0
        )
        self.trainer.step = SH_DEGREE
        self.stages: list[tuple[str, list[float]]] = []

    def step(self) -> tuple[list[tuple[str, list[float]]], float, float]:
        """The stages of a step, ms of torch's Adam, and ms of all else."""
        self.stages = []

        def timed(
            runner: ShardRunner, shards: int, work: Callable[..., None], *arguments: Any
        ) -> None:
            times = []
            for shard in range(shards):
                begin = time.process_time()
                work(shard, shard + 1, *arguments)
                times.append(1e3 * (time.process_time() - begin))
            self.stages.append((work.py_func.__name__, times))  # type: ignore[attr-defined]

        with mock.patch.object(ShardRunner, "run", timed):
            begin = time.process_time()
            image = self.trainer.render(0).image
            self.trainer.loss(image, self.trainer.targets.get(0))[0].backward()
            before, stages = time.process_time(), len(self.stages)
            self.trainer.gaussians.optimizer_step()
            end = time.process_time()
        adam = 1e3 * (end - before) - sum(sum(times) for _, times in self.stages[stages:])
        in_shards = sum(sum(times) for _, times in self.stages)
        return self.stages, adam, 1e3 * (end - begin) - in_shards - adam


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
            training = Timed(gaussians, scene)
            steps = [training.step() for _ in range(2 + STEPS)][2:]
        names = [name for name, _ in steps[0][0]]
        fastest = [
            np.min([stages[k][1] for stages, _, _ in steps], axis=0).tolist()
            for k in range(len(names))
        ]
        adam, serial = (float(np.median([step[part] for step in steps])) for part in (1, 2))
        one = sum(map(sum, fastest)) + adam + serial
        if shards == TILE_SHARDS[0]:
            camera = scene.train[0].camera
            print(
                f"\n{title}, {len(gaussians):,} Gaussians, {camera.width}x{camera.height}: "
                f"{one:.1f} ms on a thread"
            )
            print(f"  serial {serial:.1f} ms, Adam by torch {adam:.1f} ms")
            for name, times in zip(names, fastest, strict=True):
                mean = sum(times) / len(times)
                spans = "  ".join(f"{makespan(times, threads):6.2f}" for threads in THREADS)
                skew = f"longest/mean {max(times) / mean:4.2f}"
                print(f"  {name:<18} {sum(times):6.2f} ms in {len(times):2}, {skew}: {spans}")
        speedups = []
        for threads in THREADS:
            ms = sum(makespan(times, threads) for times in fastest) + adam / threads + serial
            speedups.append(f"{threads}: {one / ms:4.2f}x")
        print(f"  {shards:2} shards of tiles: {one:5.1f} ms on a thread; {'  '.join(speedups)}")


if __name__ == "__main__":
    torch.set_num_threads(1)
    asked = sys.argv[1:]
    if not asked:
        simulate("gsbench bench", *make_scene("trained", 500, 375, 100_000))
    for folder, width in zip(asked[::2], asked[1::2], strict=True):
        simulate(folder, *trained(Path(folder), int(width)))
