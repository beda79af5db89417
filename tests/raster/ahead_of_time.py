"""Compile Triton kernels, with the arguments of real launches, for GPUs that are not present.

Then read registers, spills and loops from the machine code.
"""

import re
import shutil
import tempfile
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource, make_backend
from triton.runtime.jit import JITFunction, create_function_from_signature

from tests.processes import completed

TARGETS = (80, 86, 89, 90, 120)  # A100, RTX 30, RTX 40, H100/H200, RTX 50
BINARIES = Path(triton.__file__).parent / "backends" / "nvidia" / "bin"


@dataclass(frozen=True)
class Launch:
    """One launch of a kernel with its arguments, constants and options."""

    kernel: JITFunction
    named: dict[str, Any]

    @property
    def name(self):
        return str(self.kernel.fn.__name__)


@contextmanager
def recorded(monkeypatch):
    """Within this context, kernels do not run; their launches are appended to the list."""
    launches = []

    def run(kernel, *, grid, warmup, **named):
        launches.append(Launch(kernel, named))

    with monkeypatch.context() as patch:
        patch.setattr(JITFunction, "run", run)
        yield launches


def specialization(launch, compute_capability=90):
    """The properties for which Triton compiles a kernel separately.

    These are types, constants, and which arguments are divisible by 16.
    """
    backend = make_backend(GPUTarget("cuda", compute_capability, 32))
    binder = create_function_from_signature(launch.kernel.signature, launch.kernel.params, backend)
    _, kinds, _ = binder(**launch.named)
    return tuple(kinds)


@dataclass(frozen=True)
class Compiled:
    """What the assembler reports about a kernel."""

    registers: int
    spilled: int  # bytes of local memory
    shared: int  # bytes
    loops: dict[str, int]  # instructions of each innermost loop, by its label
    text: str  # SASS

    @property
    def inner_loop(self):
        """Instructions of the longest innermost loop; 0 without one."""
        return max(self.loops.values(), default=0)


def compile_for(launch, compute_capability):
    target = GPUTarget("cuda", compute_capability, 32)
    backend = make_backend(target)
    kernel = launch.kernel
    binder = create_function_from_signature(kernel.signature, kernel.params, backend)
    bound, kinds, options = binder(**launch.named)
    options, signature, constants, attributes = kernel._pack_args(
        backend, launch.named, bound, kinds, options
    )
    source = ASTSource(kernel, signature, constants, attributes)
    made = triton.compile(source, target=target, options=options.__dict__)
    with tempfile.TemporaryDirectory() as folder:
        binary = Path(folder) / "kernel.cubin"
        binary.write_bytes(made.asm["cubin"])
        usage = _run("cuobjdump", "--dump-resource-usage", str(binary))
        text = _run("nvdisasm", "--print-code", str(binary))
    found = {key: int(value) for key, value in re.findall(r"(REG|STACK|LOCAL|SHARED):(\d+)", usage)}
    return Compiled(
        found["REG"], found["STACK"] + found["LOCAL"], found["SHARED"], innermost_loops(text), text
    )


def innermost_loops(text):
    """For each innermost loop, the number of instructions from its label to the branch back."""
    labels = {}
    loops = {}
    place = 0
    for line in text.splitlines():
        if label := re.match(r"\s*(\.L_\w+):", line):
            labels[label[1]] = place
        elif re.search(r"/\*[0-9a-f]{4,}\*/", line):
            place += 1
            if (jump := re.search(r"\bBRA(?:\.U)?\b.*`\((\.L_\w+)\)", line)) and jump[1] in labels:
                loops[jump[1]] = (labels[jump[1]], place)
    # leave out the trap at the end, a jump to itself
    loops = {label: (begin, end) for label, (begin, end) in loops.items() if end - begin > 1}
    inner = {
        label
        for label, (begin, end) in loops.items()
        if not any(begin <= b and e <= end and (b, e) != (begin, end) for b, e in loops.values())
    }
    return {label: loops[label][1] - loops[label][0] for label in sorted(inner)}


def _run(tool, *arguments):
    path = BINARIES / tool
    command = str(path) if path.exists() else shutil.which(tool)
    if command is None:
        pytest.skip(f"this Triton has no {tool}")
    return completed([command, *arguments]).stdout
