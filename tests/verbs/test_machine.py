"""``gsbench doctor`` on made-up machines: with GPUs, without GPUs, and as this one is."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import tomllib
from collections.abc import Iterable

import pytest
import torch

from gsbench.verbs import machine
from gsbench.verbs.machine import Finding
from tests.conftest import ROOT

GB = 10**9


def said(findings: Iterable[Finding]) -> list[tuple[str, str]]:
    return [(finding.verdict, finding.text) for finding in findings]


def of_devices(topic: str) -> list[Finding]:
    return [finding for finding in machine.check_devices() if finding.topic == topic]


@pytest.fixture
def no_gpu(monkeypatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.version, "cuda", None)
    monkeypatch.setattr(machine, "installed_gpus", list)


@pytest.fixture
def gpus(monkeypatch) -> None:
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
    assert {extra for _, extra in machine.OPTIONAL.values()} == extras


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
    assert texts["raster=gsplat"].startswith("runs on device=cuda, not on cpu; ")


def test_rasterizers_on_a_gpu(gpus, monkeypatch):
    from gsbench.raster import executors

    monkeypatch.setattr(
        executors.importlib.util, "find_spec", lambda name: None if name == "gsplat" else object()
    )
    texts = dict(text.split(" ", 1) for _, text in said(of_devices("rasterizer")))
    assert texts["raster=auto"] == "is cpu on cpu and triton on cuda"
    assert texts["raster=triton"].startswith("on cuda: ")
    assert texts["raster=reference"].startswith("on cpu and cuda: ")
    assert texts["raster=gsplat"].startswith("needs gsplat: ")


def test_doctor_on_this_machine_covers_all_topics(tmp_path, capsys):
    machine.doctor([], tmp_path / "runs")
    lines = capsys.readouterr().out.splitlines()
    topics = {line.split()[1] for line in lines}
    assert {"gsbench", "python", "torch", "gpu", "rasterizer", "runs", "weights"} <= topics
    assert all(line.split()[0] in ("ok", "note", "bad") for line in lines)
    for module in machine.OPTIONAL:
        (line,) = (line for line in lines if line.split()[1] == module)
        assert ("not installed" in line) == (importlib.util.find_spec(module) is None)
