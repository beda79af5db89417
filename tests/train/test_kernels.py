"""Kernels are compiled before a training, once for all processes, and outside its clock."""

import subprocess
import sys
from contextlib import suppress
from threading import Event
from time import sleep
from types import SimpleNamespace

import numba
import pytest

from gsbench.densify import NoDensifier
from gsbench.raster.cpu import executor
from gsbench.raster.reference import ReferenceRasterizer
from gsbench.system.resources import CLOCK, CompileClock
from gsbench.train import adam_cpu, kernels, loss_cpu, trainer
from gsbench.train.kernels import compiled_beside, tiny_step


def test_the_tiny_step_calls_the_kernels_of_a_training_with_the_same_types(lab, monkeypatch):
    called = {}

    def noting(name, kernel):
        def call(*arguments):
            called[name] = tuple(numba.typeof(argument) for argument in arguments)
            return kernel(*arguments)

        return call

    for module in (executor, loss_cpu, adam_cpu):
        for name, value in [*vars(module).items()]:
            if not getattr(value, "targetoptions", {"forceinline": True}).get("forceinline"):
                monkeypatch.setattr(module, name, noting(name, value))
    kinds = []
    for steps in (tiny_step(lab.rasterizer), tiny_step(ReferenceRasterizer())):
        called.clear()
        list(steps)
        kinds.append(dict(called))
    own, of_reference = kinds
    assert of_reference == {"loss_rows": own["loss_rows"]}
    for by_autograd, fewer in ((False, {"adam_rows"}), (True, set())):
        training = lab.new(NoDensifier(), by_autograd=by_autograd)
        called.clear()
        training.iterate(lab.folder)
        assert called == {name: kind for name, kind in own.items() if name not in fewer}


def test_kernels_are_compiled_beside_other_work_and_waited_for(monkeypatch):
    compiled, begun = [], Event()

    def steps(*parts):
        for part in parts:
            if part == "bad":
                raise RuntimeError("no memory")
            yield compiled.append(part)

    def compiled_with(*parts, wanted=True):
        monkeypatch.setattr(kernels, "tiny_step", lambda rasterizer: steps(*parts))
        with compiled_beside(ReferenceRasterizer(), wanted) as wait:
            wait()
        return compiled

    assert compiled_with("a", "b") == ["a", "b"]
    assert compiled_with("c", wanted=False) == ["a", "b"]
    with pytest.raises(RuntimeError, match="no memory"):
        compiled_with("bad")

    def slow(rasterizer):
        begun.set()
        sleep(0.5)
        yield from steps("last", "never")

    monkeypatch.setattr(kernels, "tiny_step", slow)
    with suppress(ZeroDivisionError), compiled_beside(ReferenceRasterizer(), True):
        begun.wait(10)
        raise ZeroDivisionError  # the block ends early
    assert compiled == ["a", "b", "last"]


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
