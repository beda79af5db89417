"""Rasterizers side by side in one run."""

from __future__ import annotations

import statistics
from dataclasses import replace
from pathlib import Path
from typing import Any

from gsbench.bench.peer import PEERS
from gsbench.bench.stepper import WARM_UP_STEPS, Setting, Stepper, peak_memory
from gsbench.logs import Progress, progress
from gsbench.system.isolate import run_isolated


def run_bench(
    rasters: list[str],
    sizes: list[tuple[int, int]],
    counts: list[int],
    ply: Path | None = None,
    repeats: int = 5,
    threads: int | None = None,
    memory: bool = True,
    scene: str = "trained",
    stages: bool = False,
) -> list[dict[str, Any]]:
    """Time the training step with each of ``rasters`` for each image size (width, height) and count of Gaussians.

    The rasters take turns, step by step; all times are medians over ``repeats``, in ms. ``forward_ms`` is the render,
    ``backward_ms`` the backward pass of loss and render, ``step_ms`` everything; ``loss_ms`` and ``adam_ms`` are the
    rest, and ``cpu_ms`` is the processor time of the step on all threads. ``step_ratio`` is the median of the turns'
    quotients with the first of ``rasters``. ``steps_per_second`` is that of whole training steps, which nothing is
    waited for in between; ``fps`` is frames a second, rendered alone; ``waits_per_step`` how often one of them makes
    the host wait for a GPU. ``peak_memory_mb`` is that of a fresh process that makes the same steps (on a GPU: of
    torch's allocations there), None if ``memory`` is false. With ``stages`` a row also has ms a
    step by kernel, of further steps. With ``ply`` that model is timed, not ``counts``. Raises
    InputError for a raster that cannot run here.
    """
    rows = []
    with progress("bench") as report:
        for width, height in sizes:
            for count in counts if ply is None else [0]:
                setting = Setting(scene, width, height, count, ply, threads)
                rows += _compare(rasters, setting, repeats, memory, stages, report)
    return rows


def _compare(
    rasters: list[str], setting: Setting, repeats: int, memory: bool, stages: bool, report: Progress
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
                speeds[raster] += [] if speed is None else [speed]
    rows = []
    for raster, stepper in steppers.items():
        waits = stepper.waits()
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
            "steps_per_second": _median(speeds[raster]) if speeds[raster] else None,
            "fps": _median(frames[raster]),
            "waits_per_step": None if waits is None else waits.total(),
            "threads": stepper.threads,
            "device": stepper.device.type,
        }
        if stages:
            report(f"{what}, stages", turns, turns, raster)
            row["stages"] = stepper.stages(repeats)
        if raster in PEERS:
            row["note"] = PEERS[raster].note
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
