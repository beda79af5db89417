"""The proof of an executor: it passes correct kernels, and finds faults that a test plants.

It is made once for each version.
"""

import dataclasses
import json
import os
import shutil
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from shlex import split
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import gsbench
from gsbench.cli import run
from gsbench.raster.contract import Case
from gsbench.raster.cpu import CpuRasterizer
from gsbench.raster.executors import EXECUTORS
from gsbench.raster.reference import ReferenceRasterizer
from gsbench.runs.trial_record import RasterProof
from gsbench.system.isolate import CrashError
from gsbench.system.locks import is_held
from gsbench.system.machine import cpu_name
from gsbench.train import proof as module
from gsbench.train.loss import torch_photometric_loss
from gsbench.train.proof import create_proven, known_proof, proof_of, prove, stamp_of
from tests.conftest import ROOT
from tests.helpers import read_json, refusal, write
from tests.processes import completed
from tests.raster.conftest import interpreter_fault

CPU = torch.device("cpu")
TINY = Case(7, 5, 20, sh_degree=3)


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache/gsbench/proofs"


def passing(raster="triton", failures=()):
    return RasterProof(
        raster=raster,
        device="a GPU",
        versions={"torch": "2"},
        errors={},
        failures=[*failures],
        seconds=1.0,
    )


def test_the_cpu_kernels_pass_with_small_errors():
    # messages and kept proofs name these scenes
    names = ["33x49-n50-sh3", "48x37-n120-sh2", "20x17-n700-sh1", "7x5-n20-sh0"]
    assert [str(scene) for scene in module.SCENES] == names
    proof = prove(CpuRasterizer(), CPU)
    assert proof.failures == []
    assert {
        "image",
        "gradient of means",
        "splitting_matrix",
        "footprint (pixels)",
        "loss",
    } <= proof.errors.keys()
    assert proof.errors["bits of a second run"] == 0
    assert all(error < 1e-5 for error in proof.errors.values()), proof.errors


def test_a_departure_names_the_quantity_and_the_place():
    class Wrong(CpuRasterizer):
        def render(self, *arguments, **options):
            output = super().render(*arguments, **options)
            change = torch.zeros_like(output.image)
            change[2, 4] = 0.25
            output.image = output.image + change
            return output

    failures = prove(Wrong(), CPU, (TINY,)).failures
    assert "7x5-n20-sh3: image is off by up to 2.50e-01 at pixel (4, 2)" in failures
    assert all(line.startswith("7x5-n20-sh3: ") for line in failures)


def test_a_fault_of_the_loss_is_a_failure():
    proof = prove(
        CpuRasterizer(),
        CPU,
        (TINY,),
        lambda image, target: torch_photometric_loss(image, target, 0.21),
    )
    *losses, image = proof.failures
    assert len(losses) == 10
    for step, line in enumerate(losses, start=1):
        assert line.startswith("7x5-n20-sh3: loss is off by up to 1.")
        assert line.endswith(f" of itself at training step {step}")
    assert image.startswith("7x5-n20-sh3: trained image is off by up to ")
    assert image.endswith(" at training step 10")


def test_values_that_are_not_finite_fail_and_are_not_kept_as_errors():
    class Missing(CpuRasterizer):
        def render(self, *arguments, **options):
            output = super().render(*arguments, **options)
            output.image, output.alpha = output.image * torch.nan, output.alpha[:-1]
            return output

    proof = prove(Missing(), CPU, (TINY,))
    assert not proof.passed
    assert not {"image", "alpha"} & proof.errors.keys()


def test_a_driver_error_is_a_failure_and_a_lack_of_memory_is_raised():
    class Broken(ReferenceRasterizer):
        error = RuntimeError("CUDA error: an illegal memory access\nmore")

        def render(self, *arguments, **options):
            raise self.error

    assert prove(Broken(), CPU, (TINY,)).failures == [
        "RuntimeError: CUDA error: an illegal memory access"
    ]
    Broken.error = torch.OutOfMemoryError("full")
    with pytest.raises(torch.OutOfMemoryError):
        prove(Broken(), CPU, (TINY,))


def test_bits_that_differ_between_runs_are_a_failure_if_the_same_bits_are_promised():
    class Restless(CpuRasterizer):
        count = 0

        def render(self, *arguments, **options):
            output = super().render(*arguments, **options)
            Restless.count += 1
            output.radii = output.radii + (Restless.count == 3)
            return output

    lines = prove(Restless(), CPU, (TINY,)).failures
    assert lines == ["7x5-n20-sh3: bits of a second run is off by up to 1.00e+00 tensors at radii"]


# ---- a proof is kept for the versions that it depends on


def count_proofs(made, monkeypatch):
    def prove(raster, device):
        made.append(raster)
        return passing(raster)

    monkeypatch.setattr(module, "prove_apart", prove)


def test_a_proof_is_kept_and_made_again_for_another_version(cache, monkeypatch):
    made = []
    count_proofs(made, monkeypatch)
    assert known_proof("cpu", CPU) is None
    for _ in range(2):
        assert proof_of("cpu", CPU).passed
    assert made == ["cpu"]
    assert proof_of("cpu", CPU, again=True).passed
    assert len(made) == 2
    for name in ("driver", "torch", "triton", "kernels"):
        versions = module.versions_on(CPU) | {name: "another"}
        monkeypatch.setattr(module, "versions_on", lambda device, versions=versions: versions)
        proof_of("cpu", CPU)
    assert len(made) == 6
    assert len(list(cache.glob("cpu-*.json"))) == 5


@pytest.mark.parametrize(
    "source",
    [
        "raster/triton/composite.py",
        "raster/formulas.py",
        "raster/staged.py",
        "train/loss_triton.py",
    ],
)
def test_a_changed_source_file_of_the_kernels_changes_the_version(tmp_path, monkeypatch, source):
    before = module.versions_on(CPU)
    package = tmp_path / "gsbench"
    shutil.copytree(module.PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(module, "PACKAGE", package)
    assert module.versions_on(CPU) == before
    with (package / source).open("a") as stream:
        stream.write("# changed\n")
    changed = module.versions_on(CPU)
    assert {name for name in before if before[name] != changed[name]} == {"kernels"}


def test_a_failed_proof_is_repeated(monkeypatch):
    results = [passing("cpu", failures=("image is off",)), passing("cpu")]
    monkeypatch.setattr(module, "prove_apart", lambda *_: results.pop(0))
    assert not proof_of("cpu", CPU).passed
    assert known_proof("cpu", CPU).failures == ["image is off"]
    assert proof_of("cpu", CPU).passed


def test_without_a_writable_cache_each_call_proves_again_and_logs_it(cache, monkeypatch, caplog):
    made = []
    count_proofs(made, monkeypatch)
    write(cache, "a file where the folder should be")
    for _ in range(2):
        assert proof_of("cpu", CPU).passed
    assert len(made) == 2
    assert "each process repeats it" in caplog.text


def test_a_crash_of_the_process_is_a_failure(monkeypatch):
    def crash(*_, **__):
        raise CrashError("the proof of raster=cpu crashed (SIGSEGV); its last lines: none")

    monkeypatch.setattr(module, "run_isolated", crash)
    proof = proof_of("cpu", CPU)
    assert proof.failures == ["the proof of raster=cpu crashed (SIGSEGV); its last lines: none"]
    assert (proof.raster, proof.device, proof.seconds) == ("cpu", cpu_name(), 0.0)
    assert proof.versions == module.versions_on(CPU)


def test_a_device_without_memory_for_a_proof_is_named(monkeypatch):
    asked = []

    def full(*arguments, what):
        asked.append((*arguments, what))
        raise torch.OutOfMemoryError("full")

    monkeypatch.setattr(module, "run_isolated", full)
    with refusal("device=cuda:1 has no memory left to prove raster=triton"):
        module.prove_apart("triton", "cuda:1")
    assert asked == [(module._prove_by_name, "triton", "cuda:1", "the proof of raster=triton")]


def test_only_one_process_makes_a_proof_at_a_time(cache, monkeypatch):
    lock = stamp_of("cpu", CPU).with_suffix(".lock")
    held = []

    def prove(raster, device):
        held.append((raster, device, is_held(lock)))
        return passing(raster)

    monkeypatch.setattr(module, "prove_apart", prove)
    proof_of("cpu", CPU)
    assert held == [("cpu", "cpu", True)]
    assert not is_held(lock)
    assert lock.parent == cache


def test_the_stamp_depends_on_the_rasterizer_and_on_the_device(monkeypatch):
    gpu = torch.device("cuda:1")
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (9, device.index))
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "GPU")
    assert module._device_name(gpu) == "GPU (9.1)"
    files = [stamp_of("cpu", CPU), stamp_of("triton", CPU), stamp_of("cpu", gpu)]
    assert [path.name.split("-")[0] for path in files] == ["cpu", "triton", "cpu"]
    digests = {path.stem.split("-")[1] for path in files}
    assert len(digests) == 3
    assert {len(digest) for digest in digests} == {16}


@pytest.mark.parametrize(
    "known, has_gpu, answers, said",
    [
        ("550.54\n", True, ["1"], "550.54"),
        (None, True, ["551.2", "551.2"], "551.2"),
        (None, True, [], ""),
        (None, False, ["551.2"], ""),
    ],
)
def test_the_system_knows_the_driver_or_nvidia_smi_does(known, has_gpu, answers, said, monkeypatch):
    def read(path, encoding):
        if known is None:
            raise FileNotFoundError(path)
        return known

    monkeypatch.setattr(Path, "read_text", read)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: has_gpu)
    monkeypatch.setattr(module, "nvidia_smi", lambda query: {"driver_version": answers}[query])
    assert module._driver() == said


@pytest.mark.slow
def test_two_processes_make_one_proof(tmp_path):
    code = (
        "import torch; from gsbench.train.proof import proof_of; assert proof_of('cpu', "
        "torch.device('cpu')).passed"
    )
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path / "cache")}
    script = f"import logging; logging.basicConfig(level=logging.INFO)\n{code}"

    def process(_):
        done = completed([sys.executable, "-c", script], env=environment)
        return done.stderr

    with ThreadPoolExecutor(2) as pool:
        logs = list(pool.map(process, range(2)))
    assert sorted("comparing it with the reference" in text for text in logs) == [False, True]


# ---- the choice of an executor


@pytest.fixture
def gpu(monkeypatch):
    """A GPU on which all executors seem to be installed.

    The dictionary maps executors to their failures.
    """
    failures = {}
    monkeypatch.setattr(type(EXECUTORS[0]), "is_installed", property(lambda self: True))
    monkeypatch.setattr(module, "create_rasterizer", lambda name, *_: name)
    monkeypatch.setattr(module, "_device_name", lambda device: "a GPU")
    monkeypatch.setattr(
        module, "prove_apart", lambda raster, _: passing(raster, tuple(failures.get(raster, [])))
    )
    return failures


@pytest.mark.parametrize(
    "failing, taken",
    [
        ([], "triton"),
        (["triton"], "reference"),
        (["reference"], "triton"),
    ],
)
def test_auto_takes_the_first_executor_that_passes(gpu, failing, taken, caplog):
    gpu |= {
        name: ["33x49-n50-sh3: image is off by up to 3.00e-01 at pixel (4, 2)", "alpha"]
        for name in failing
    }
    chosen = create_proven("auto", torch.device("cuda"))
    assert chosen.rasterizer == taken
    assert chosen.proof.raster == taken
    over = failing[: len(chosen.passed_over)]
    assert [line.split()[0] for line in chosen.passed_over] == [f"raster={name}" for name in over]
    for line in chosen.passed_over:
        assert (
            "image is off by up to 3.00e-01 at pixel (4, 2) (and 1 more); torch 2; please report "
            "it with " in line
        )
        assert read_json(Path(line.split()[-1]))["failures"] == gpu["triton"]
        assert line in caplog.text


def test_a_named_executor_that_fails_is_an_error(gpu):
    gpu["triton"] = ["alpha is off"]
    with refusal(r"raster=triton is not used: it departs .* alpha is off.*device=cpu trains"):
        create_proven("triton", torch.device("cuda"))
    gpu["reference"] = ["alpha is off"]
    with refusal(r"raster=triton .*raster=reference "):
        create_proven("auto", torch.device("cuda"))


@pytest.mark.parametrize("fault", ["", "means has other bits after 10 recorded steps"])
def test_direct_steps_that_fail_are_turned_off_with_a_line(gpu, fault, monkeypatch, caplog):
    proof = dataclasses.replace(passing("triton", ()), direct_fault=fault)
    monkeypatch.setattr(module, "prove_apart", lambda *_: proof)
    made = SimpleNamespace(direct_steps=True)
    monkeypatch.setattr(module, "create_rasterizer", lambda *_: made)
    assert create_proven("triton", torch.device("cuda")).rasterizer is made
    assert made.direct_steps == (not fault)
    line = f"raster=triton: steps use autograd and take longer, since {fault}"
    assert (line in caplog.text) == bool(fault)


def test_nothing_is_proven_on_a_cpu(monkeypatch):
    monkeypatch.setattr(module, "prove_apart", None)
    chosen = create_proven("auto", CPU)
    assert (chosen.rasterizer.name, chosen.proof, chosen.passed_over) == ("cpu", None, ())


def test_doctor_makes_a_proof_on_request_and_shows_the_last_one(monkeypatch, capsys):
    made = {"cpu": passing("cpu")}
    monkeypatch.setattr(module, "prove_apart", lambda raster, device: made[raster])
    assert run(split("doctor --prove --raster cpu --device cpu --json")) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["raster"], told["passed"], told["seconds"]) == ("cpu", True, 1.0)
    made["cpu"] = passing("cpu", ("image is off",))
    assert run(split("doctor --prove --raster cpu --device cpu")) == 1
    assert (
        f"image is off\ntorch 2; please report it with {stamp_of('cpu', CPU)}"
        in capsys.readouterr().out
    )
    assert run(["doctor"]) == 1
    assert (
        "bad   proof        raster=cpu departs from the reference on a GPU"
        in capsys.readouterr().out
    )
    assert run(["doctor", "--json"]) == 2


# ---- faults in the kernels: each is planted in a copy of gsbench that Triton's interpreter runs

COMPOSITE, FOOTPRINT, PROJECTION, GEOMETRY = (
    f"raster/triton/{name}.py" for name in ("composite", "footprint", "projection", "geometry")
)
FORMULAS = "raster/formulas.py"
FAULTS = {
    "none": ("raster/triton/layout.py", "SEGMENT = tl.constexpr(256)", "SEGMENT = tl.constexpr(8)"),
    "a sign": (COMPOSITE, "tl.fma(light, shine, -behind)", "tl.fma(light, shine, behind)"),
    "a missing term of the light behind": (
        COMPOSITE,
        "behind = tl.fma(weight, shine, behind)",
        "pass",
    ),
    "no state at the border of a segment": (
        COMPOSITE,
        "light = tl.load(border + TRANSMITTANCE, mask=crossed, other=light)",
        "pass",
    ),
    "a short segment": (
        COMPOSITE,
        "tl.minimum(begin + SEGMENT, end)",
        "tl.minimum(begin + SEGMENT - 1, end)",
    ),
    "a program of a long list that looks at another's pixels": (
        COMPOSITE,
        "along = (steps * LANE_COLUMNS)",
        "along = (tl.arange(0, steps.shape[0]) * LANE_COLUMNS)",
    ),
    "swapped channels": (
        COMPOSITE,
        "tl.fma(weight, record[7], green)",
        "tl.fma(weight, record[8], green)",
    ),
    "a footprint of one pixel too many": (
        FOOTPRINT,
        "blended = (power >= LOG2_ALPHA_MIN) & (position < seen)",
        "blended = power >= LOG2_ALPHA_MIN",
    ),
    "a missing term of the position's gradient": (
        FORMULAS,
        "view_z = -(by_focal * inverse_z + ",
        "view_z = -(",
    ),
    "a sign of the quaternion's gradient": (
        FORMULAS,
        "qz * w_x - qx * w_z",
        "qz * w_x + qx * w_z",
    ),
    "a missing term of the splitting matrix": (PROJECTION, "q11 - e * h", "q11"),
    "a factor in harmonics of degree 3": (GEOMETRY, "8 * T2 * yz", "4 * T2 * yz"),
    "a swapped axis": (FORMULAS, "(v.r10, v.r11, v.r12)", "(v.r11, v.r10, v.r12)"),
    "a weight of the loss": (
        "train/loss_triton.py",
        "(W0, W1, W2, W3, W4, W5)[k]",
        "(W0, W1, W2, W3, W5, W4)[k]",
    ),
}
# Small for the interpreter, but with rows of blocks, lists of several segments, and harmonics of
# all degrees.
SCENE = "Case(18, 17, 40, sh_degree=3, log_scale=-1.0, logit=-1.0, spread=0.4)"
PROVE = f"""
import json, torch
import tests.raster.conftest  # makes the interpreter faster
from gsbench.raster.contract import Case
from gsbench.raster.triton.executor import TritonRasterizer
from gsbench.train.loss_triton import TritonLoss
from gsbench.train.proof import prove
print(json.dumps(prove(TritonRasterizer(), torch.device("cpu"), ({SCENE},), TritonLoss(0.2)).failures))
"""


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
def test_a_planted_fault_is_found(tmp_path, fault):
    triton = pytest.importorskip("triton")
    if reason := interpreter_fault(triton.__version__, np.__version__):
        pytest.skip(reason)
    package = tmp_path / "gsbench"
    shutil.copytree(
        Path(gsbench.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__")
    )
    for source, sound, faulty in {FAULTS["none"], FAULTS[fault]}:
        text = (package / source).read_text()
        assert text.count(sound) == 1
        (package / source).write_text(text.replace(sound, faulty))
    environment = os.environ | {
        "TRITON_INTERPRET": "1",
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)]),
        "XDG_CACHE_HOME": str(tmp_path / "cache"),
    }
    words = [sys.executable, "-c", PROVE]
    done = completed(words, cwd=tmp_path, env=environment, timeout=900)
    failures = json.loads(done.stdout.splitlines()[-1])
    assert bool(failures) == (fault != "none"), failures
