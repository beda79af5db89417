"""The table of executors: what `raster=` accepts, what `auto` takes, and that nothing else lists them."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from gsbench.errors import InputError
from gsbench.pipeline.parts import locate
from gsbench.raster import create_rasterizer, executors
from gsbench.raster.contract import CASES, departures
from gsbench.raster.executors import EXECUTORS, Executor, find_executor, resolve
from gsbench.raster.reference import ReferenceRasterizer
from gsbench.system.install import conf_dir, install_command

CPU = torch.device("cpu")


def installed(monkeypatch: pytest.MonkeyPatch, *packages: str) -> None:
    """Make as if of the executors' packages these were installed, and no others."""
    monkeypatch.setattr(executors.importlib.util, "find_spec", lambda name: object() if name in packages else None)


@pytest.mark.parametrize("executor", EXECUTORS, ids=lambda executor: executor.name)
def test_facts_agree_with_the_class(executor: Executor) -> None:
    if executor.name == "triton" and not executor.is_installed:
        pytest.skip("Triton has no wheels for this system")
    kind = locate(executor.target, "raster", [])
    assert kind.name == executor.name
    assert ("threads" in inspect.signature(kind).parameters) == executor.takes_threads
    assert (executor.package is None) == (executor.install == "")


def test_every_executor_has_its_file_in_conf() -> None:
    assert {path.stem for path in (conf_dir() / "raster").glob("*.yaml")} == set(executors.names())


def test_names_are_the_same_everywhere() -> None:
    root = Path(__file__).resolve().parents[2]
    for document in ("README.md", "docs/rasterizer.md"):
        for name in executors.names():
            assert f"`{name}`" in (root / document).read_text(encoding="utf-8"), (document, name)


def test_the_table_loads_no_torch() -> None:
    code = "import sys, gsbench.raster.executors, gsbench.raster.base; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=300).returncode == 0


def test_auto(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    assert resolve("auto", "cpu").name == "cpu"
    installed(monkeypatch, "gsplat")
    assert resolve("auto", "cuda").name == "gsplat"
    assert caplog.text == ""
    installed(monkeypatch)
    assert resolve("auto", "cuda").name == "reference"
    assert "slow reference" in caplog.text
    assert install_command("gsplat") in caplog.text
    assert resolve("auto", "mps").name == "reference"


def test_what_cannot_run_is_said_with_what_can(monkeypatch: pytest.MonkeyPatch) -> None:
    assert resolve("reference", "cpu").name == "reference"
    assert isinstance(create_rasterizer("reference", CPU, threads=1), ReferenceRasterizer)
    with pytest.raises(InputError, match=r"opengl is not known; choose auto, reference, cpu, .*_target_"):
        resolve("opengl", "cpu")
    with pytest.raises(InputError, match="raster=gsplat runs on device=cuda, not on cpu; choose from reference, cpu"):
        resolve("gsplat", "cpu")
    with pytest.raises(InputError, match=r"raster=cpu runs on device=cpu, not on cuda; choose from reference, "):
        resolve("cpu", "cuda")
    installed(monkeypatch)
    with pytest.raises(InputError, match=f"raster=gsplat needs gsplat: {re.escape(install_command('gsplat'))}"):
        resolve("gsplat", "cuda")
    assert find_executor("gsplat").obstacle("cuda") is not None


@pytest.mark.parametrize(
    ("version", "is_old"), [("3.3.1", True), ("2.9", True), ("3.4.0", False), ("3.10.0+git1234", False), ("4.0", False)]
)
def test_triton_has_a_least_version(version: str, is_old: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    installed(monkeypatch, "triton", "gsplat")
    monkeypatch.setattr(importlib.metadata, "version", lambda package: version)
    assert (find_executor("triton").obstacle("cuda") is not None) == is_old
    assert resolve("auto", "cuda").name == ("gsplat" if is_old else "triton")
    if is_old:
        with pytest.raises(InputError, match=rf"raster=triton needs triton 3.4 or newer, and {version} is installed: "):
            resolve("triton", "cuda")


def test_a_triton_of_another_name_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(package: str) -> str:
        raise importlib.metadata.PackageNotFoundError(package)

    installed(monkeypatch, "triton")
    monkeypatch.setattr(importlib.metadata, "version", unknown)
    assert resolve("triton", "cuda").name == "triton"


def test_departures_are_told() -> None:
    class Wrong(ReferenceRasterizer):
        def render(self, *arguments, **options):  # type: ignore[no-untyped-def]
            out = super().render(*arguments, **options)
            return dataclasses.replace(out, image=out.image * 1.01, radii=out.radii + 1)

    class Broken(ReferenceRasterizer):
        def render(self, *arguments, **options):  # type: ignore[no-untyped-def]
            raise RuntimeError("no kernel")

    class Plain(ReferenceRasterizer):
        name = "plain"  # and no offers

    case = CASES[-1]
    assert departures(ReferenceRasterizer(), cases=(case,)) == []
    assert departures(Plain(), cases=(case,)) == []
    told = departures(Wrong(), cases=(case,))
    assert any("image is off" in line for line in told)
    assert any("radii differ for 20 of 20" in line for line in told)
    assert any("gradient of sh_dc is off by 1" in line for line in told)
    assert departures(Broken(), cases=(case,)) == [
        f"{case}: RuntimeError: no kernel",
        "without Gaussians: RuntimeError: no kernel",
    ]
