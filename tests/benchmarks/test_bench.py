"""``gsbench bench``: what it prints and measures. No test looks at how long anything takes."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
import torch
from torch.autograd import DeviceType
from torch.autograd.profiler_util import FunctionEventAvg

from gsbench.bench.measure import LONGEST_KERNELS, Setting, Stepper, per_step, run_bench
from gsbench.bench.scenes import (
    SCENES,
    camera_before,
    frontal_camera,
    random_gaussians,
    skewed_gaussians,
    trained_like_gaussians,
)
from gsbench.errors import InputError
from gsbench.gaussians.model import Gaussians
from gsbench.gaussians.ply import write_ply
from gsbench.raster.cpu import CpuRasterizer
from gsbench.raster.cpu import executor as cpu_executor
from gsbench.raster.reference import project
from gsbench.verbs.machine import _bench_parser, bench
from tests.benchmarks.counters import timed_kernels

pytestmark = pytest.mark.slow

KEYS = {"raster", "size", "count", "forward_ms", "backward_ms", "step_ms", "peak_memory_mb"}


def test_rows_have_the_times_of_each_size_count_and_rasterizer() -> None:
    rows = run_bench(
        ["cpu", "reference"], [(40, 30), (33, 17)], [50, 100], repeats=2, threads=1, memory=False
    )
    assert [(row["size"], row["count"], row["raster"]) for row in rows] == [
        (size, count, raster)
        for size in ("40x30", "33x17")
        for count in (50, 100)
        for raster in ("cpu", "reference")
    ]
    for row in rows:
        assert row.keys() >= KEYS
        parts = row["forward_ms"] + row["loss_ms"] + row["backward_ms"] + row["adam_ms"]
        assert min(row["forward_ms"], row["backward_ms"], row["adam_ms"]) > 0
        # the median of two steps is their mean
        assert row["step_ms"] == pytest.approx(parts, abs=0.01)
        assert row["peak_memory_mb"] is None


def test_rasterizers_are_compared_with_the_first_in_steps_and_frames() -> None:
    first, second = run_bench(
        ["cpu", "reference"], [(40, 30)], [50], repeats=3, memory=False, scene="random"
    )
    assert first["step_ratio"] == 1
    assert second["step_ratio"] > 1  # the reference is meant to be read
    assert (first["scene"], first["device"]) == ("random", "cpu")
    assert min(first["steps_per_second"], second["steps_per_second"]) > 0
    assert min(first["fps"], second["fps"]) > 0


def test_kernels_and_waits_of_a_step_on_a_cpu() -> None:
    """On a CPU the profiler sees torch's operators; nothing waits."""
    (row,) = run_bench(["cpu"], [(40, 30)], [50], repeats=1, memory=False, kernels=True)
    assert row["kernels_ms"]["_Render"] > 0
    assert list(row["kernels_ms"])[-1] == "all others"
    assert row["waits"] == row["waits_ms"] == {}


def test_times_on_a_gpu_are_those_of_kernels_alone() -> None:
    """In the profiler's events, an operator's launch counts neither as a kernel nor as a wait."""

    def event(key: str, kind: DeviceType, count: int, cpu: float, gpu: float) -> FunctionEventAvg:
        average = FunctionEventAvg()
        average.key, average.device_type, average.count = key, kind, count
        average.self_cpu_time_total, average.self_device_time_total = cpu, gpu
        return average

    kernels = [
        event(f"kernel{k}", DeviceType.CUDA, 10, 0.0, 1e3 * (k + 1))
        for k in range(LONGEST_KERNELS + 2)
    ]
    others = [event("aten::sort", DeviceType.CPU, 10, 7e4, 5e4)]
    waits = [event("cudaStreamSynchronize", DeviceType.CPU, 15, 2e4, 0.0)]
    found = per_step([*kernels, *others, *waits], 10, torch.device("cuda"))
    assert found["kernels_ms"]["kernel13"] == pytest.approx(1.4)
    assert list(found["kernels_ms"])[:2] == ["kernel13", "kernel12"]
    assert found["kernels_ms"]["all others"] == pytest.approx(0.1 + 0.2)
    assert sum(found["kernels_ms"].values()) == pytest.approx(sum(range(1, 15)) / 10)
    assert (found["waits"], found["waits_ms"]) == (
        {"cudaStreamSynchronize": 1.5},
        {"cudaStreamSynchronize": 2.0},
    )


def test_whole_steps_do_not_change_the_scene() -> None:
    stepper = Stepper("cpu", Setting("trained", 40, 30, 50, threads=1))
    before = [
        tensor.detach().clone() for tensor in stepper.trainer.gaussians.values.tensors().values()
    ]
    for _ in range(3):
        stepper.step()
        stepper.steps_per_second()
    assert stepper.trainer.step == 6
    assert stepper.trainer.sh_degree == 3
    assert stepper.trainer.densifier.statistics["visible_count"].max() == 3  # of whole steps alone
    for tensor, old in zip(
        stepper.trainer.gaussians.values.tensors().values(), before, strict=True
    ):
        assert torch.equal(tensor, old)


def test_a_users_rasterizer_is_timed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "twice.py").write_text(
        "from gsbench.raster.reference import ReferenceRasterizer\n"
        "class Twice(ReferenceRasterizer):\n    name = 'twice'\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    assert (
        bench(["--raster", "twice.Twice", "--size", "20x20", "--count", "9", "--repeats", "1"]) == 0
    )
    assert capsys.readouterr().out.splitlines()[1].split()[0] == "twice.Twice"


def test_json_with_memory(capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        bench(["--raster", "cpu", "--size", "40x30", "--count", "60", "--json", "--repeats", "1"])
        == 0
    )
    (row,) = json.loads(capsys.readouterr().out)
    assert row.keys() >= KEYS
    assert (row["raster"], row["size"], row["count"]) == ("cpu", "40x30", 60)
    # a process with torch, and no more than a small scene
    assert 50 < row["peak_memory_mb"] < 10_000


def test_table_of_a_ply(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "model.ply"
    write_ply(trained_like_gaussians(70), path)
    assert bench(["--ply", str(path), "--size", "40x30", "--repeats", "1", "--no-memory"]) == 0
    header, line = capsys.readouterr().out.splitlines()
    assert "forward_ms" in header
    assert line.split()[:3] == ["cpu", "40x30", "70"]


@pytest.mark.parametrize("make", [trained_like_gaussians, random_gaussians, skewed_gaussians])
def test_scene_is_seeded_and_seen(make: Callable[[int], Gaussians]) -> None:
    scene = make(500)
    assert torch.equal(scene.means, make(500).means)
    for camera in (frontal_camera(60, 45), camera_before(scene, 60, 45)):
        output = CpuRasterizer(threads=1).render(scene, camera, 3, torch.zeros(3))
        assert 0.3 < output.visible.float().mean() <= 1
        assert output.alpha.mean() > 0.3


def longest_list(scene: Gaussians) -> float:
    """The longest list of a tile over the mean one; a Gaussian counts in the tile of its mean."""
    camera = frontal_camera(500, 375)
    tile = (project(scene, camera).means.double() + 0.5).div(16).floor().long()  # [M, 2]
    inside = (tile >= 0).all(-1) & (tile[:, 0] < 500 // 16) & (tile[:, 1] < 375 // 16)
    lists = (tile[inside, 1] * 32 + tile[inside, 0]).bincount().double()
    return (lists.max() / lists[lists > 0].mean()).item()


def test_the_skewed_scene_has_the_skew_of_a_trained_model() -> None:
    """A trained courtyard has 1,054 entries per block at most, and 117 on average."""
    assert longest_list(skewed_gaussians(50_000)) == pytest.approx(1054 / 117, rel=0.25)
    assert longest_list(trained_like_gaussians(50_000)) < 2


def test_every_scene_can_be_chosen() -> None:
    (choice,) = (action for action in _bench_parser()._actions if action.dest == "scene")
    assert tuple(choice.choices) == tuple(SCENES)


def test_kernels_are_timed_and_put_back_when_a_step_fails() -> None:
    kernel = cpu_executor.composite_tiles
    stepper = Stepper("cpu", Setting("trained", 40, 30, 60, threads=1))
    with suppress(ArithmeticError), timed_kernels() as times:
        stepper.step()
        assert cpu_executor.composite_tiles is not kernel
        raise ArithmeticError
    assert cpu_executor.composite_tiles is kernel
    assert {
        "project_shards",
        "composite_tiles",
        "composite_backward_tiles",
        "similarity_rows",
    } <= times.keys()
    assert min(times.values()) >= 0


@pytest.mark.parametrize(
    ("arguments", "cause"),
    [
        (["--size", "500"], "500x375"),
        (["--count", "0"], "at least 1"),
        (["--raster", "nosuch", "--no-memory"], "nosuch"),
        (["--ply", "/no/such.ply"], "such.ply"),
        (
            ["--raster", "gsplat", "--no-memory"],
            "raster=gsplat runs on a CUDA device, and torch finds none",
        ),
    ],
)
def test_bad_input_is_refused(arguments: list[str], cause: str) -> None:
    if arguments[1].startswith("gsplat") and torch.cuda.is_available():
        pytest.skip("there is a GPU")
    with pytest.raises(InputError, match=cause):
        bench(arguments)
