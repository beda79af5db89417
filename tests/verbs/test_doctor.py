"""``gsbench doctor`` on machines that this one is not: with GPUs, without compilers, with folders that are shut."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import tomllib
from collections.abc import Iterable
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from gsbench import cli
from gsbench.runs.stages import TRAIN, Step
from gsbench.runs.store import Store
from gsbench.system import jit
from gsbench.verbs import doctor
from gsbench.verbs.doctor import Finding
from tests.conftest import ROOT

GB = 10**9


def said(findings: Iterable[Finding]) -> list[tuple[str, str]]:
    return [(finding.verdict, finding.text) for finding in findings]


@pytest.fixture
def no_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.version, "cuda", None)
    monkeypatch.setattr(doctor, "installed_gpus", list)


@pytest.fixture
def gpus(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """Two GPUs, as torch tells of them."""
    machine = SimpleNamespace(capability=(9, 0))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda index: f"GPU {'AB'[index]}")
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda index: (20 * GB, 24 * GB))
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda index: machine.capability)
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.version, "hip", None)
    return machine


def test_gpus_with_their_memory(gpus: SimpleNamespace, monkeypatch: pytest.MonkeyPatch) -> None:
    assert said(doctor.check_gpu()) == [("ok", f"GPU {name}, 20 GB of 24 GB free") for name in "AB"]
    gpus.capability = (7, 5)
    assert all(verdict == "note" and "older than Triton" in text for verdict, text in said(doctor.check_gpu()))
    monkeypatch.setattr(torch.version, "hip", "7.0")
    assert all(verdict == "note" and "never tested" in text for verdict, text in said(doctor.check_gpu()))


def test_every_extra_is_known() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = set(project["optional-dependencies"]) - {"dev", "docs"}
    assert {extra for _, extra in doctor.OPTIONAL.values()} == extras


def test_no_gpu_and_why(no_gpu: None, monkeypatch: pytest.MonkeyPatch) -> None:
    assert said(doctor.check_gpu()) == [("note", "none (this torch is a build for CPUs): raster=auto uses the CPU")]
    monkeypatch.setattr(doctor, "installed_gpus", lambda: ["0"])
    ((verdict, text),) = said(doctor.check_gpu())
    assert verdict == "note"
    assert "1 NVIDIA GPU here, but this torch is a build for CPUs" in text
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    assert "no usable NVIDIA driver" in said(doctor.check_gpu())[0][1]


def test_rasterizers(no_gpu: None, monkeypatch: pytest.MonkeyPatch) -> None:
    texts = dict(text.split(" ", 1) for _, text in said(doctor.check_executors()))
    assert texts["raster=auto"] == "is cpu on cpu"
    assert texts["raster=cpu"].startswith("on cpu: compiled")
    assert texts["raster=gsplat"] == "needs a cuda device, and there is none"


def test_rasterizers_on_a_gpu(gpus: SimpleNamespace, monkeypatch: pytest.MonkeyPatch) -> None:
    from gsbench.raster import executors

    monkeypatch.setattr(executors.importlib.util, "find_spec", lambda name: None if name == "gsplat" else object())
    texts = dict(text.split(" ", 1) for _, text in said(doctor.check_executors()))
    assert texts["raster=auto"] == "is cpu on cpu and triton on cuda"
    assert texts["raster=triton"].startswith("on cuda: ")
    assert texts["raster=reference"].startswith("on cpu and cuda: ")
    assert texts["raster=gsplat"].startswith("needs gsplat: ")


def test_triton_that_is_too_old_is_said_with_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_version", lambda package: "3.3.1")
    monkeypatch.setattr(importlib.metadata, "version", lambda package: "3.3.1")
    ((verdict, text),) = said(doctor.check_triton())
    assert verdict == "note"
    assert "needs triton 3.4 or newer, and 3.3.1 is installed" in text
    assert "torch>=2.8" in text


def test_kernels_are_said_to_be_where_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert said(doctor.check_kernels()) == [("ok", f"those for the CPU are kept in {jit.cache_base()}")]
    monkeypatch.setattr(jit, "cache_base", lambda: tmp_path / f"{jit.TEMPORARY_PREFIX}x")
    ((verdict, text),) = said(doctor.check_kernels())
    assert verdict == "note"
    assert "NUMBA_CACHE_DIR" in text


def test_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GSBENCH_DATA", str(tmp_path))
    assert [verdict for verdict, _ in said(doctor.check_data())] == ["note", "note"]
    (tmp_path / "garden").mkdir()
    (tmp_path / "tandt" / "truck").mkdir(parents=True)
    (tmp_path / "db" / "playroom").mkdir(parents=True)
    first, second = said(doctor.check_data())
    assert first[0] == second[0] == "ok"
    assert "1 of 9 scenes of Mip-NeRF 360" in first[1]
    assert "gsbench fetch mipnerf360" in first[1]
    assert "2 of 4 scenes" in second[1]


def test_the_whole_of_it_on_this_machine(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    doctor.main([], tmp_path / "runs")
    lines = capsys.readouterr().out.splitlines()
    topics = {line.split()[1] for line in lines}
    assert {"gsbench", "python", "torch", "gpu", "rasterizer", "kernels", "data", "runs", "weights"} <= topics
    assert all(line.split()[0] in ("ok", "note", "bad") for line in lines)
    for module in doctor.OPTIONAL:
        (line,) = (line for line in lines if line.split()[1] == module)
        assert ("not installed" in line) == (importlib.util.find_spec(module) is None)


def test_a_sample_of_the_store_is_read_whole(tmp_path: Path) -> None:
    store = Store(tmp_path / "store")
    folders = [
        store.get(Step(TRAIN, {"x": x}, lambda folder: (folder / "model").write_text("m"))).path  # type: ignore[arg-type,return-value]
        for x in range(10)
    ]
    assert said(doctor.check_store(tmp_path)) == [("ok", "10 results are as they were written")]
    assert said(doctor.check_store(tmp_path, 25)) == [("ok", "3 results are as they were written, of 10 in all")]
    for folder in folders:  # a flipped byte with its time kept
        state = (folder / "model").stat()
        (folder / "model").write_text("n")
        os.utime(folder / "model", ns=(state.st_atime_ns, state.st_mtime_ns))
    found = said(doctor.check_store(tmp_path, 25))
    assert [verdict for verdict, _ in found] == ["note", "note", "note", "ok"]
    assert "model differs from what was written" in found[0][1]


@pytest.mark.parametrize("text", ["0", "-5%", "101", "x", "nan", "%"])
def test_a_sample_is_a_share(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["doctor", "--store", f"--sample={text}"]) == 2
    assert "such as 5%" in capsys.readouterr().err
    assert cli.run(["doctor", "--sample=5%"]) == 2
    assert "--store" in capsys.readouterr().err
