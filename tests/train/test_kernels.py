"""Kernels are compiled before a training, once for all processes, and outside its clock."""

import subprocess
import sys
from types import SimpleNamespace

import numba
import pytest
import torch

from gsbench.densify import NoDensifier
from gsbench.gaussians.trainable import ParameterState, Update
from gsbench.raster.cpu import CpuRasterizer, executor
from gsbench.raster.reference import ReferenceRasterizer
from gsbench.system.resources import CLOCK, CompileClock
from gsbench.train import adam_cpu, loss_cpu, trainer
from gsbench.train.kernels import compiled_beside, kernels_of
from gsbench.train.loss import PhotometricLoss
from tests.raster.strategies import Case


def test_the_signatures_are_those_of_a_training_step(monkeypatch):
    called = {}

    def noting(name, kernel):
        def call(*arguments):
            called[name] = tuple(numba.typeof(argument) for argument in arguments)
            return kernel(*arguments)

        return call

    listed = {}
    for kernel, signature in kernels_of(CpuRasterizer(1)):
        name = kernel.py_func.__name__
        listed[name] = signature
        for module in (executor, loss_cpu, adam_cpu):
            if hasattr(module, name):
                monkeypatch.setattr(module, name, noting(name, kernel))
    case = Case(33, 17, 30, sh_degree=1)
    gaussians = case.gaussians().map(lambda tensor: tensor.float().requires_grad_(True))
    image = CpuRasterizer(1).render(gaussians, case.camera(), 1, torch.zeros(3)).image
    loss, _, _ = PhotometricLoss(threads=1)(image, torch.zeros(17, 33, 3, dtype=torch.uint8))
    loss.backward()
    state = ParameterState(0.1, 1, {key: torch.zeros(30, 3) for key in ("first", "second")})
    adam_cpu.CpuAdam(1)([Update(gaussians.means, gaussians.means.grad, state)])
    assert called == listed


def test_kernels_are_compiled_beside_other_work_and_waited_for(monkeypatch):
    compiled = []

    class Kernel:
        def compile(self, signature):
            compiled.append(signature)
            if signature == "bad":
                raise RuntimeError("no memory")

    def compiled_with(*signatures, wanted=True):
        kernels = [(Kernel(), signature) for signature in signatures]
        monkeypatch.setattr("gsbench.train.kernels.kernels_of", lambda rasterizer: kernels)
        with compiled_beside(ReferenceRasterizer(), wanted) as wait:
            wait()
        return compiled

    assert compiled_with("a", "b") == ["a", "b"]
    assert compiled_with("c", wanted=False) == ["a", "b"]
    with pytest.raises(RuntimeError, match="no memory"):
        compiled_with("bad")


def test_only_the_own_rasterizer_needs_its_kernels():
    own = [kernel.py_func.__name__ for kernel, _ in kernels_of(ReferenceRasterizer())]
    assert own == ["similarity_rows", "gradient_rows"]


def test_seconds_of_compilation_are_not_of_the_training(lab, monkeypatch):
    now = [0.0]
    clock = SimpleNamespace(perf_counter=lambda: now[0], monotonic=lambda: now[0])
    monkeypatch.setattr(trainer, "time", clock)

    class Compiling(NoDensifier):
        def observe(self, step, render):
            now[0] += 10
            CLOCK.seconds += 7

    training = lab.new(Compiling(), iterations=5)
    training.run(lab.folder)
    assert training.seconds == pytest.approx(4 * 3)  # the last iteration has no statistics


def test_compiled_seconds_are_reported_once():
    clock = CompileClock(5.0)
    assert clock.report() == 5.0
    clock.seconds += 2
    assert (clock.report(), clock.report()) == (2.0, 0.0)


PROGRAM = """
from gsbench.system.jit import kernel

@kernel
def add(a, b):
    return a + b

if __name__ == "__main__":
    add(1, 2)
    print(sum(add.stats.cache_misses.values()), sum(add.stats.cache_hits.values()))
"""


def test_of_two_processes_one_compiles_and_the_other_loads(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    (tmp_path / "program.py").write_text(PROGRAM)
    command = [sys.executable, str(tmp_path / "program.py")]
    pair = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    said = sorted(process.communicate(timeout=300)[0].strip() for process in pair)
    assert said == ["0 1", "1 0"]
