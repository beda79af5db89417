"""``gsbench bench``: what it prints and measures. No test looks at how long anything takes."""

import json
from contextlib import contextmanager, suppress
from pathlib import Path
from shlex import split
from types import SimpleNamespace

import pytest
import torch

from benchmarks.counters import timed_kernels
from gsbench.bench import measure
from gsbench.bench.measure import (
    Setting,
    Stepper,
    device_of,
    peak_memory,
    run_bench,
)
from gsbench.bench.scenes import SCENES, trained_like_gaussians
from gsbench.gaussians.ply import write_ply
from gsbench.raster.cpu import executor as cpu_executor
from gsbench.verbs import VERBS
from gsbench.verbs.machine import bench
from tests.helpers import refusal

KEYS = {"raster", "size", "count", "forward_ms", "backward_ms", "step_ms", "peak_memory_mb"}
QUICK = split("--size 40x30 --repeats 1 --no-memory")
# Step times of the turns: two of warm-up, and three that count
TURNS = {"cpu": (900.0, 800.0, 1.0, 5.0, 3.0), "reference": (900.0, 800.0, 6.0, 5.0, 12.0)}


class ScriptedStepper:
    """A stepper whose times are those in ``TURNS``; ``calls`` are the rasterizers in turn."""

    calls = []  # noqa: RUF012
    device = torch.device("cpu")

    def __init__(self, raster, setting):
        self.raster, self.times = raster, iter(TURNS[raster])
        self.count, self.threads = setting.count or 70, setting.threads or 4

    def step(self):
        self.calls.append(self.raster)
        self.time = next(self.times)
        return {"step_ms": self.time}

    def steps_per_second(self):
        return 1000 / self.time

    def frames_per_second(self):
        return 2000 / self.time


@pytest.fixture
def reports(monkeypatch):
    """The lines of progress of a run with scripted steppers, and with memory of as many MiB."""
    said = []

    @contextmanager
    def progress(name):
        yield lambda *words: said.append((name, *words))

    def isolated(work, raster, setting, what):
        assert (work, what) == (peak_memory, f"measuring the memory of raster={raster}")
        return float(len(said))

    monkeypatch.setattr(ScriptedStepper, "calls", [])
    for name, stand_in in (
        ("Stepper", ScriptedStepper),
        ("progress", progress),
        ("run_isolated", isolated),
    ):
        monkeypatch.setattr(measure, name, stand_in)
    return said


def test_rows_have_the_medians_of_each_setting_and_rasterizer(reports):
    both = ["cpu", "reference"]
    settings = [Setting("trained", 40, 30, 50), Setting("crowded", 33, 17, 1000)]
    rows = run_bench(both, settings, repeats=3)
    assert [(row["size"], row["count"], row["raster"]) for row in rows] == [
        (setting.size, setting.count, raster) for setting in settings for raster in both
    ]
    assert ScriptedStepper.calls[:10] == both * 5  # they take turns
    one, other = rows[2:]
    assert one == {
        **{"raster": "cpu", "scene": "crowded", "size": "33x17", "count": 1000},
        **{"step_ms": 3, "step_ratio": 1, "steps_per_second": 333.333, "fps": 666.667},
        **{"threads": 4, "device": "cpu", "peak_memory_mb": 23},
    }
    # ratios of 6, 1 and 4, turn by turn
    assert (other["step_ms"], other["step_ratio"], other["fps"]) == (6, 4, 333.333)
    assert reports[:2] == [("bench", "40x30, 50 Gaussians", 0, 5, name) for name in both]
    assert reports[9:11] == [
        ("bench", "40x30, 50 Gaussians", 4, 5, "reference"),
        ("bench", "40x30, 50 Gaussians", 2, 2, "memory of cpu"),
    ]
    assert reports[12][1] == "33x17, 1,000 Gaussians"


def test_a_model_may_be_timed_and_the_memory_left_out(reports):
    (row,) = run_bench(
        ["cpu"], [Setting("trained", 40, 30, 0, Path("my/m.ply"), 2)], 3, memory=False
    )
    assert (row["scene"], row["count"], row["threads"]) == ("my/m.ply", 70, 2)
    assert row["peak_memory_mb"] is None
    assert reports[0] == ("bench", "40x30, m.ply", 0, 5, "cpu")


@pytest.fixture(params=["cpu", "cuda"])
def paced(request, monkeypatch):
    """A stepper on a device whose work takes known seconds, and its waits for a GPU."""
    clock, waits = [0.0], []

    def spend(seconds, result=None):
        clock[0] += seconds
        return result

    def loss(image, target):
        assert (image, target) == ("image of 0", "target of 0")
        return spend(2, [SimpleNamespace(backward=lambda: spend(4))])

    stepper = object.__new__(Stepper)
    stepper.device = torch.device(request.param)
    stepper.trainer = SimpleNamespace(
        targets=SimpleNamespace(get=lambda view: spend(100, f"target of {view}")),
        render=lambda view: spend(1 + view, SimpleNamespace(image=f"image of {view}")),
        loss=loss,
        gaussians=SimpleNamespace(optimizer_step=lambda: spend(8)),
        iterate=lambda folder: spend(16),
        losses=SimpleNamespace(wait=lambda: spend(32)),
    )
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: waits.append(1))
    monkeypatch.setattr(measure.time, "perf_counter", lambda: clock[0])
    monkeypatch.setattr(measure.time, "process_time", lambda: 3 * clock[0])
    return stepper, waits


def test_a_whole_step_and_the_parts_of_one_are_timed_each_by_itself(paced):
    stepper, waits = paced
    assert stepper.step() == {
        **{"forward_ms": 1000, "loss_ms": 2000, "backward_ms": 4000, "adam_ms": 8000},
        **{"step_ms": 48_000, "cpu_ms": 144_000},
    }
    on_gpu = stepper.device.type == "cuda"
    assert len(waits) == (7 if on_gpu else 0)
    # a GPU makes ten steps between two readings of the clock; a last wait is for the losses
    assert stepper.steps_per_second() == (10 / 192 if on_gpu else 1 / 48)
    assert stepper.frames_per_second() == 1


@pytest.mark.parametrize("device, resets", [("cpu", 0), ("cuda", 1)])
def test_peak_memory_is_that_of_three_steps(device, resets, monkeypatch):
    done = []
    made = {"x": SimpleNamespace(device=torch.device(device), step=lambda: done.append("step"))}
    monkeypatch.setattr(measure, "Stepper", lambda raster, setting: made[raster])
    monkeypatch.setattr(measure, "reset_peak_memory", lambda device: done.append("reset"))
    monkeypatch.setattr(measure, "peak_memory_mb", lambda device: float(len(done)))
    assert peak_memory("x", Setting("trained", 40, 30, 50)) == resets + 3
    assert done == ["reset"] * resets + ["step"] * 3


def test_a_gpu_is_for_rasterizers_that_need_one_and_for_a_users_own(monkeypatch):
    for is_there, own in ((True, "cuda"), (False, "cpu")):
        monkeypatch.setattr(torch.cuda, "is_available", lambda: is_there)  # noqa: B023
        assert device_of("mine.Rasterizer").type == own
        assert device_of("cpu").type == "cpu"
    with refusal("triton runs on a CUDA device, and torch finds none"):
        device_of("triton")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert device_of("triton").type == "cuda"
    disabled = []
    monkeypatch.setattr(measure, "disable_tf32", lambda: disabled.append(1))
    monkeypatch.setattr(measure, "make_scene", lambda *_: disabled[0] / 0)
    with pytest.raises(ZeroDivisionError):  # not an IndexError: it was called before
        Stepper("triton", Setting("trained", 40, 30, 50))


@pytest.mark.slow
def test_whole_steps_do_not_change_the_scene(monkeypatch):
    threads = []
    monkeypatch.setattr(torch, "set_num_threads", threads.append)
    stepper = Stepper("reference", Setting("trained", 40, 30, 50, threads=3))
    assert (stepper.count, stepper.threads, threads) == (50, 3, [3])
    assert Stepper("reference", Setting("trained", 4, 3, 5)).threads == torch.get_num_threads()
    before = [
        tensor.detach().clone() for tensor in stepper.trainer.gaussians.values.tensors().values()
    ]
    for _ in range(3):
        stepper.step()
        stepper.steps_per_second()
    assert stepper.trainer.step == 9
    assert stepper.trainer.sh_degree == 3
    assert stepper.trainer.densifier.statistics["visible_count"].max() == 6  # of whole steps alone
    for tensor, old in zip(
        stepper.trainer.gaussians.values.tensors().values(), before, strict=True
    ):
        assert torch.equal(tensor, old)


def test_a_users_rasterizer_is_timed(tmp_path, monkeypatch, capsys):
    (tmp_path / "twice.py").write_text(
        "from gsbench.raster.reference import ReferenceRasterizer\n"
        "class Twice(ReferenceRasterizer):\n    name = 'twice'\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    assert bench(["--raster", "twice.Twice", "--count", "9", *QUICK]) == 0
    assert capsys.readouterr().out.splitlines()[1].split()[0] == "twice.Twice"


@pytest.mark.slow
def test_json_with_memory(capsys):
    assert bench(split("--raster cpu --size 40x30 --count 60 --json --repeats 1")) == 0
    (row,) = json.loads(capsys.readouterr().out)
    assert row.keys() >= KEYS
    assert (row["raster"], row["size"], row["count"]) == ("cpu", "40x30", 60)
    # a process with torch, and no more than a small scene
    assert 50 < row["peak_memory_mb"] < 10_000


def test_table_of_a_ply(tmp_path, capsys):
    path = tmp_path / "model.ply"
    write_ply(trained_like_gaussians(70), path)
    assert bench(["--ply", str(path), "--raster", "reference", *QUICK]) == 0
    header, line = capsys.readouterr().out.splitlines()
    assert "forward_ms" in header
    assert line.split()[:3] == ["reference", "40x30", "70"]


def test_every_scene_can_be_chosen():
    assert list(SCENES) in VERBS["bench"]["arguments"]["--scene NAME"]


@pytest.mark.slow
def test_kernels_are_timed_and_put_back_when_a_step_fails():
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
        "loss_rows",
    } <= times.keys()
    assert min(times.values()) >= 0
