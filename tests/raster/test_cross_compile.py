"""The CPU kernels compile, with vector instructions, for processors that are not present."""

import re
from functools import cache

import llvmlite.binding as llvm
import numba
import pytest
import torch

from gsbench.gaussians.trainable import LearningRates, TrainableGaussians
from gsbench.raster.contract import Case
from gsbench.raster.cpu import CpuRasterizer, binning, composite, projection
from gsbench.train import loss_cpu
from gsbench.train.loss import photometric_loss

pytestmark = pytest.mark.slow

MODULES = (binning, composite, projection, loss_cpu)
TARGETS = {  # triple, processor
    "neon": ("aarch64-unknown-linux-gnu", "neoverse-n1"),
    "sve": ("aarch64-unknown-linux-gnu", "neoverse-v1"),
    "apple": ("arm64-apple-macosx", "apple-m1"),
}
# They only count and move numbers.
FREE_OF_VECTORS = {
    "sort_by_depth",
    "start_tiles",
    "fill_shards",
    "balance_tiles",
    "pair_shards",
    "place_rows",
}


@cache
def kernels():
    """The kernels of a training step and of a footprint, by name; runs one step to compile them."""
    case = Case(33, 49, 50, sh_degree=3)
    trainable = TrainableGaussians(case.gaussians().map(torch.Tensor.float), LearningRates(), 1.0)
    output = CpuRasterizer(threads=1).render(trainable.values, case.camera(), 3, torch.zeros(3))
    output.footprint()
    photometric_loss(output.image, torch.zeros(49, 33, 3, dtype=torch.uint8))[0].backward()
    trainable.optimizer_step()
    found = {}
    for module in MODULES:
        for name, value in vars(module).items():
            own = hasattr(value, "py_func") and value.py_func.__module__ == module.__name__
            if own and value.signatures and not value.targetoptions.get("forceinline"):
                found[name] = value
    return found


@cache
def intermediate_code(name):
    """LLVM's code of a kernel, without the lines and attributes that name the processor."""
    function = kernels()[name]
    compiled = numba.njit(nogil=True, error_model="numpy", _nrt=False)(function.py_func)
    compiled.compile(function.signatures[0])
    text = compiled.inspect_llvm(compiled.signatures[0])
    text = re.sub(r"^target (triple|datalayout) = .*$", "", text, flags=re.M)
    return re.sub(r'"(target-cpu|target-features|tune-cpu|probe-stack)"(="[^"]*")?', "", text)


def check(target, name):
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    triple, processor = TARGETS[target]
    machine = llvm.Target.from_triple(triple).create_target_machine(cpu=processor, opt=3)
    module = llvm.parse_assembly(intermediate_code(name))
    module.triple, module.data_layout = triple, str(machine.target_data)
    module.verify()
    assembly = machine.emit_assembly(module)
    if name not in FREE_OF_VECTORS:
        assert re.search(r"\bfm(la|ul)(\.4s)?\s+v\d+", assembly), f"{name}: no vector instruction"
        called = set(re.findall(r"\bbl\s+_?(\w+)", assembly))
        assert not called & {"fmaf", "sqrtf", "floorf", "ceilf", "fma", "exp2f"}, (
            f"{name} calls {called}"
        )


@pytest.mark.parametrize("target", TARGETS)
def test_the_costliest_kernel_compiles_for_arm(target):
    check(target, "composite_backward_tiles")


@pytest.mark.parametrize("target", TARGETS)
def test_kernels_compile_for_arm(target):
    assert len(kernels()) >= 12
    for name in kernels():
        check(target, name)
