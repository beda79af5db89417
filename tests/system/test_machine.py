"""The record of the machine that a result was computed on."""

import json
import os
import platform
import sys

import pytest
import torch

from gsbench.system import machine
from gsbench.system.machine import (
    cpu_name,
    describe_machine,
    kernel_target,
    kind_of_machine,
    load_numba,
    x86_level,
)
from tests.helpers import refusal
from tests.processes import completed

ARM_64 = (
    "processor\t: 0\nBogoMIPS\t: 243.75\nCPU implementer\t: 0x41\nCPU architecture: 8\nCPU "
    "part\t: 0xd40\n"
)
XEON = (
    "processor : 0\nvendor_id : GenuineIntel\nmodel name :  Intel(R)  Xeon(R)\n\nprocessor : "
    "1\nmodel name : other\n"
)


def test_record_is_plain_text_and_full():
    record = describe_machine(torch.device("cpu"))
    assert json.loads(json.dumps(record)) == record
    assert set(record) == {"cpu", "architecture", "kernels", "torch", "device"}
    assert all(record.values())
    assert record["device"] == "cpu"
    assert record["cpu"] in kind_of_machine(record)


@pytest.mark.parametrize(
    "content, name",
    [
        (XEON, "Intel(R) Xeon(R)"),
        (ARM_64, "ARM implementer 0x41 part 0xd40"),
        ("Model : Raspberry Pi 5", "Raspberry Pi 5"),
    ],
)
def test_names_of_processors_on_linux(content, name, tmp_path, monkeypatch):
    (tmp_path / "cpuinfo").write_text(content)
    monkeypatch.setattr(machine, "CPU_INFO", tmp_path / "cpuinfo")
    monkeypatch.setattr(sys, "platform", "linux")
    assert cpu_name.__wrapped__() == name


@pytest.mark.parametrize("system", ["linux", "darwin", "win32", "sunos"])
def test_a_processor_without_a_name_is_called_by_its_architecture(system, tmp_path, monkeypatch):
    monkeypatch.setattr(machine, "CPU_INFO", tmp_path / "missing")
    monkeypatch.setenv("PATH", str(tmp_path))  # no program of the system
    monkeypatch.delenv("PROCESSOR_IDENTIFIER", raising=False)
    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.setattr(platform, "processor", lambda: "")
    assert cpu_name.__wrapped__() == platform.machine()


def test_levels_follow_the_psabi():
    v2 = {"sse3", "ssse3", "sse4.1", "sse4.2", "popcnt", "cx16", "sahf", "sse2"}
    v3 = v2 | {"avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe"}
    v4 = v3 | {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}
    assert [x86_level(features) for features in (set(), v2, v3, v4)] == [
        f"x86-64-v{k}" for k in (1, 2, 3, 4)
    ]
    assert x86_level(v4 - {"avx512vl"}) == "x86-64-v3"
    assert x86_level(v4 - {"sse4.2"}) == "x86-64-v1"


def test_the_target_of_kernels_follows_numba_cpu_name():
    code = "from gsbench.system.machine import kernel_target; print(kernel_target())"
    changed = dict(os.environ) | {"NUMBA_CPU_NAME": "generic"}
    asked = completed([sys.executable, "-c", code], env=changed)
    assert asked.stdout.startswith("generic")
    if "NUMBA_CPU_NAME" not in os.environ:
        assert not kernel_target().startswith("generic")


@pytest.mark.parametrize(
    "variable, said",
    [
        *((f"NUMBA_NUM_THREADS={value}", "from 1 on") for value in ("0", "-1", "", "²", "1.5")),
        *((f"NUMBA_DISABLE_JIT={value}", "from 0 on") for value in ("x", "-1")),
        ("NUMBA_NUM_THREADS=1", None),
        ("NUMBA_DISABLE_JIT=0", None),
    ],
)
def test_a_variable_that_numba_cannot_read_is_refused(variable, said, monkeypatch):
    monkeypatch.setenv(*variable.split("="))
    with refusal(said and rf"^{variable}: .* a whole number {said}"):
        load_numba()


def test_kernels_are_for_the_processor_and_its_level(monkeypatch):
    features = "+" + ",+".join(machine.X86_LEVELS["x86-64-v2"]) + ",-avx"
    monkeypatch.setattr(machine, "numba_target", lambda: ("haswell", features))
    for system, target in (
        ("x86_64", "haswell, x86-64-v2"),
        ("AMD64", "haswell, x86-64-v2"),
        ("aarch64", "haswell"),
    ):
        monkeypatch.setattr(platform, "machine", lambda system=system: system)
        assert kernel_target() == target
    record = {"cpu": "A", "kernels": "B", "torch": "C", "device": "cpu"}
    assert kind_of_machine(record) == "A (B, torch C)"
    assert kind_of_machine(record | {"device": "H100"}) == "H100, A (B, torch C)"


def test_numba_reads_no_settings_of_the_current_folder(tmp_path):
    (tmp_path / ".numba_config.yaml").write_text("disable_jit: 1\nopt: 0\n")
    code = (
        "import gsbench.system.jit\nfrom numba.core import config\nconfig.reload_config()\n"
        "print(config.DISABLE_JIT, int(config.OPT))"
    )
    asked = completed([sys.executable, "-c", code], cwd=tmp_path)
    assert asked.stdout == "0 3\n"
