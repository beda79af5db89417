"""``gsbench doctor`` on made-up machines: with GPUs, without GPUs, and as this one is."""

import importlib.metadata
import importlib.util
import sys
import tomllib
from pathlib import Path
from shlex import split
from types import SimpleNamespace

import pytest
import torch

from gsbench.verbs import machine
from tests.conftest import ROOT
from tests.helpers import refusal

GB = 10**9


def said(findings):
    return [(verdict, text) for verdict, _, text in findings]


def of_devices(topic):
    return [finding for finding in machine.check_devices() if finding[1] == topic]


@pytest.fixture
def no_gpu(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.version, "cuda", None)
    monkeypatch.setattr(machine, "installed_gpus", list)


@pytest.fixture
def gpus(monkeypatch):
    """Two GPUs, as torch reports them."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda index: f"GPU {'AB'[index]}")
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda index: (20 * GB, 24 * GB))
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.version, "hip", None)


def test_gpus_are_listed_with_their_memory(gpus, monkeypatch):
    assert said(of_devices("gpu")) == [("ok", f"GPU {name}, 20 GB of 24 GB free") for name in "AB"]
    monkeypatch.setattr(torch.version, "hip", "7.0")
    assert all(
        verdict == "note" and "never tested" in text for verdict, text in said(of_devices("gpu"))
    )


def test_every_extra_of_the_package_is_checked():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = set(project["optional-dependencies"]) - {"dev", "docs"}
    assert {extra for _, extra in machine.PACKAGES["optional"].values()} == extras


def test_without_a_gpu_the_cause_is_named(no_gpu, monkeypatch):
    assert said(of_devices("gpu")) == [
        ("note", "none (this torch is a build for CPUs): raster=auto uses the CPU")
    ]
    monkeypatch.setattr(machine, "installed_gpus", lambda: ["0"])
    ((verdict, text),) = said(of_devices("gpu"))
    assert verdict == "note"
    assert "1 NVIDIA GPU here, but this torch is a build for CPUs" in text
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    assert "no usable NVIDIA driver" in said(of_devices("gpu"))[0][1]


def test_rasterizers_without_a_gpu(no_gpu, monkeypatch):
    texts = dict(text.split(" ", 1) for _, text in said(of_devices("rasterizer")))
    assert texts["raster=auto"] == "is cpu on cpu"
    assert texts["raster=cpu"].startswith("on cpu: compiled")
    assert texts["raster=triton"].startswith("runs on device=cuda, not on cpu; ")


def test_rasterizers_on_a_gpu(gpus, monkeypatch):
    from gsbench.raster import executors

    monkeypatch.setattr(executors.importlib.util, "find_spec", lambda name: object())
    texts = dict(text.split(" ", 1) for _, text in said(of_devices("rasterizer")))
    assert texts["raster=auto"] == "is cpu on cpu and triton on cuda"
    assert texts["raster=triton"].startswith("on cuda: ")
    assert texts["raster=reference"].startswith("on cpu and cuda: ")


def test_doctor_on_this_machine_covers_all_topics(tmp_path, capsys):
    machine.doctor([], tmp_path / "runs")
    lines = capsys.readouterr().out.splitlines()
    topics = {line.split()[1] for line in lines}
    assert {"gsbench", "python", "torch", "gpu", "rasterizer", "runs", "weights"} <= topics
    assert all(line.split()[0] in ("ok", "note", "bad") for line in lines)
    for module in machine.PACKAGES["optional"]:
        (line,) = (line for line in lines if line.split()[1] == module)
        assert ("not installed" in line) == (importlib.util.find_spec(module) is None)


def test_doctor_names_the_packages_that_triton_compiles_with(tmp_path, monkeypatch):
    monkeypatch.setattr(machine, "version_of", lambda package: "3.7.1")
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    (finding,) = of_devices("triton")
    assert finding[0] == "note"
    assert "a C compiler: install the package gcc" in finding[2]
    (tmp_path / "gcc").write_text("")
    (tmp_path / "gcc").chmod(0o755)
    monkeypatch.setattr("sysconfig.get_paths", lambda scheme: {"include": str(tmp_path)})
    (finding,) = of_devices("triton")
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    assert f"Python.h: install the package python{version}-dev" in finding[2]
    (tmp_path / "Python.h").write_text("")
    assert not of_devices("triton")
    monkeypatch.setenv("CC", "nosuchcc -O2")
    (finding,) = of_devices("triton")
    assert "CC is nosuchcc -O2, which is not there" in finding[2]


def test_doctor_on_a_runs_folder(runs):
    assert next(machine.check_runs(runs))[0] in ("ok", "note")
    assert next(machine.check_runs(Path("/proc/nowhere")))[0] == "bad"


def test_doctor_says_what_is_missing(monkeypatch):
    monkeypatch.setattr(machine, "version_of", lambda name: "")
    found = {one[1]: one for one in machine.check_packages()}
    for name in machine.PACKAGES["required"]:
        assert found[name][0] == "bad"
        assert found[name][2].startswith("missing: ")
    for name, (purpose, _) in machine.PACKAGES["optional"].items():
        assert found[name][0] == "note"
        assert found[name][2].startswith(f"not installed; needed for {purpose}: ")
    monkeypatch.setitem(sys.modules, "torch", None)
    ((verdict, text),) = said(machine.check_devices())
    assert verdict == "bad"
    assert text.startswith("cannot be imported (")


def test_a_full_disk_is_noted(tmp_path, monkeypatch):
    for free, verdict in ((machine.LITTLE_SPACE - 1, "note"), (machine.LITTLE_SPACE, "ok")):
        monkeypatch.setattr("shutil.disk_usage", lambda _, free=free: SimpleNamespace(free=free))
        assert next(machine.check_runs(tmp_path / "a/b"))[0] == verdict


def test_proofs_are_listed_and_rasterizers_of_a_gpu_without_one_noted(gpus, monkeypatch):
    def known(name, device):
        if name == "triton" and device.index == 0:
            errors = {"image": 1e-6}
            return SimpleNamespace(
                raster=name,
                device=device,
                passed=False,
                seconds=2.6,
                errors=errors,
                direct_fault="",
            )
        return None

    obstacle = lambda self, device: "no" if self.name == "cpu" else None  # noqa: E731
    monkeypatch.setattr(type(machine.EXECUTORS[0]), "obstacle", obstacle)
    monkeypatch.setattr("gsbench.train.proof.known_proof", known)
    found = said(machine.check_proofs())
    assert (
        "bad",
        "raster=triton departs from the reference on cuda:0 (3 s): image 1.0e-06",
    ) in found
    assert ("note", "raster=triton on cuda:1: none yet; its first use makes it") in found
    assert not [text for _, text in found if " cpu" in text]


@pytest.mark.parametrize(
    "words, message",
    [
        ("--json", "belong to --prove"),
        ("--raster cpu", "belong to --prove"),
        ("--device cpu", "belong to --prove"),
    ],
)
def test_options_of_a_proof_need_prove(tmp_path, words, message):
    with refusal(message):
        machine.doctor(split(words), tmp_path)


@pytest.mark.parametrize(
    "words, message",
    [
        ("--size 15x20", "a size is WIDTHxHEIGHT"),
        ("--size 500", "a size is WIDTHxHEIGHT"),
        ("--count 0", "--count: must be a whole number in "),
        ("--count 5,x", "--count: must be a whole number in "),
        ("--ply nowhere.ply", "nowhere.ply does not exist"),
        ("--raster cpu,auto", "name those to time"),
    ],
)
def test_bad_words_of_bench_are_refused(words, message):
    with refusal(message):
        machine.bench(split(words))


def test_bench_times_what_the_words_name(monkeypatch, capsys):
    asked = []
    row = {"raster": "cpu", "size": "16x32", "count": 7, "step_ms": 1.234, "step_ratio": 0.5}
    row |= {"peak_mb": None} | dict.fromkeys(machine.NOT_SHOWN, 0)

    def run_bench(*given):
        asked.extend(given)
        return [row]

    monkeypatch.setattr("gsbench.bench.measure.run_bench", run_bench)
    words = split("--raster cpu,reference --size 16x32,32x16 --count 7,8")
    assert machine.bench([*words, "--no-memory", "--repeats", "3"]) == 0
    rasters, settings, *others = asked
    assert (rasters, others) == (["cpu", "reference"], [3, False])
    assert [(one.scene, one.size, one.count, one.ply) for one in settings] == [
        ("trained", size, count, None) for size in ("16x32", "32x16") for count in (7, 8)
    ]
    header, line = capsys.readouterr().out.splitlines()
    assert header.split() == split("raster size count step_ms step_ratio")
    assert line.split() == split("cpu 16x32 7 1.2 0.50")
