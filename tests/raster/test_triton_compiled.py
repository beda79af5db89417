"""The Triton kernels compiled for GPUs that are not present, and how often a step waits for one."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

pytest.importorskip("triton")


from gsbench.gaussians.trainable import ParameterState, Update
from gsbench.raster.contract import Case
from gsbench.raster.triton import composite, executor, lists
from gsbench.raster.triton.executor import TritonRasterizer
from gsbench.train.adam_triton import TritonAdam
from gsbench.train.loss_triton import (
    MULTIPROCESSORS,
    PROGRAMS_HELD,
    STRIP,
    TritonLoss,
    rows_of_program,
)
from tests.raster.ahead_of_time import TARGETS, compile_for, recorded, specialization

pytestmark = pytest.mark.slow

CASE = Case(33, 49, 50, sh_degree=3)
# Limits of the instructions per entry in the loops that take most of the time, a third above those
# of Triton 3.7. A mistake that moves values out of registers, or sums them across lanes too early,
# costs more than that. An entry is blended into 128 pixels, or 32 in a program of a long list.
FORWARD_ENTRY, SPLIT_ENTRY, BACKWARD_ENTRY = 113, 45, 285
# Operations for which the host waits for the device.
WAITING = (
    "_local_scalar_dense",
    "nonzero",
    "masked_select",
    "unique",
    "is_nonzero",
    "equal",
    "repeat_interleave",
)


class Answer:
    """A stand-in for `gsbench.raster.staged.Readback` that always reads 2 units and 7 pairs."""

    asked = 0

    def __init__(self, source):
        Answer.asked += 1

    def values(self):
        return torch.tensor([2, 7, 0])


@pytest.fixture
def launches(monkeypatch):
    """The launches of kernels, which are recorded instead of run."""
    Answer.asked = 0
    monkeypatch.setattr(executor, "Readback", Answer)
    with recorded(monkeypatch) as record:
        yield record


def step(case, device="cpu", absolute=False, footprint=False, **extra):
    """The render, the loss and the backward pass of one training step."""
    gaussians = case.gaussians().map(lambda tensor: tensor.float().to(device).requires_grad_())
    output = TritonRasterizer().render(
        gaussians, case.camera(), case.sh_degree, torch.zeros(3, device=device), absolute, **extra
    )
    target = torch.zeros(case.height, case.width, 3, dtype=torch.uint8, device=device)
    TritonLoss(0.2)(output.image, target)[0].backward()
    if footprint:
        output.footprint(output.alpha)
        output.footprint()
    return gaussians, output


def adam_step(case):
    """Adam as in a direct step, and as in a step with autograd."""
    seen = torch.zeros(case.count, dtype=torch.int32)
    for tensor in case.gaussians().map(lambda tensor: tensor.float()).tensors().values():
        state = ParameterState(
            0.1, 1, {name: torch.zeros_like(tensor) for name in ("first", "second")}
        )
        gradient, active = torch.zeros_like(tensor), 24 if tensor.dim() == 3 else None
        TritonAdam()([Update(tensor, gradient, state, active)], seen)
        TritonAdam()([Update(tensor, gradient, state)])
        TritonAdam()([Update(tensor, gradient, state, active, gradient)], seen, seen)


@pytest.mark.parametrize("target", TARGETS, ids="sm_{}".format)
def test_kernels_compile_without_spills(launches, target, monkeypatch):
    step(CASE)
    step(CASE, absolute=True, footprint=True)
    step(CASE, extra="splitting_matrix")
    adam_step(CASE)
    # further variants: lower degrees, and 32-bit numbers of blocks
    if target == 90:
        monkeypatch.setattr(lists, "MAX_INT16", 0)
        for degree in (0, 1, 2):
            step(replace(CASE, sh_degree=degree))
    compiled = {}
    for launch in launches:
        variant = launch.name, str(specialization(launch, target))
        if variant in compiled:
            continue
        # the default of Triton only before 3.10
        assert launch.named["enable_fp_fusion"] is True, variant
        compiled[variant] = made = compile_for(launch, target)
        print(
            f"sm_{target} {launch.name:20} {made.registers:4} registers, innermost loops "
            f"{[*made.loops.values()]}"
        )
        assert made.spilled == 0, variant
        if launch.name in ("measure_similarity", "differentiate"):
            assert made.registers <= 65_536 // (STRIP * PROGRAMS_HELD) // 8 * 8
        if launch.name == "composite":
            *_, split, whole = sorted(made.loops.values())
            assert whole / composite.UNROLL.value < FORWARD_ENTRY
            assert split / composite.UNROLL.value < SPLIT_ENTRY
        if launch.name == "composite_backward":
            assert made.inner_loop / composite.UNROLL_BACK.value < BACKWARD_ENTRY
    assert len({name for name, _ in compiled}) == 14
    # Adam has three variants for each width of a parameter
    assert len(compiled) == (24 if target == 90 else 17) + 12


def test_no_kernel_is_compiled_again_for_other_sizes(launches):
    """The numbers of Gaussians, units and pixels change all the time."""
    cases = (Case(33, 49, 50, 3), Case(32, 48, 64, 3), Case(1, 16, 1, 3))
    for case in cases:
        step(case)
    names = [launch.name for launch in launches]
    each = len(names) // len(cases)
    assert names == names[:each] * len(cases)
    kinds = [specialization(launch) for launch in launches]
    for k, name in enumerate(names[:each]):
        assert kinds[k] == kinds[k + each] == kinds[k + 2 * each], name


@pytest.mark.parametrize(
    "size", [(1600, 1060), (500, 375), (800, 530), (256, 192), (140, 105), (4000, 3000)], ids=str
)
def test_the_loss_has_work_for_all_multiprocessors(size):
    """All programs run at once, and leave less than a tenth of the room for programs empty."""
    rows = rows_of_program(size[1], 3 * size[0])
    programs = -(-3 * size[0] // STRIP) * -(-size[1] // rows)
    held = PROGRAMS_HELD * MULTIPROCESSORS
    assert programs <= held
    assert programs > 0.9 * held or rows == 8


class Watch(TorchDispatchMode):
    """Collects the operations that wait for the device or copy between it and the host."""

    def __init__(self):
        super().__init__()
        self.waits = []
        self.operations = 0

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        result = operation(*args, **(kwargs or {}))
        devices = {
            leaf.device.type
            for leaf in tree_leaves((args, kwargs, result))
            if isinstance(leaf, Tensor)
        }
        self.operations += 1
        if len(devices) > 1 or any(name in str(operation) for name in WAITING):
            self.waits.append(str(operation))
        return result


def test_a_step_waits_once_for_the_device(launches):
    """The step runs on torch's device "meta", whose tensors have no values.

    Reading a value raises an error, and `Watch` records every copy.
    """
    gaussians = CASE.gaussians().map(lambda tensor: tensor.float().to("meta").requires_grad_())
    background = torch.zeros(3, device="meta")
    target = torch.zeros(CASE.height, CASE.width, 3, dtype=torch.uint8, device="meta")
    rasterizer, loss = TritonRasterizer(), TritonLoss(0.2)
    with Watch() as watch:
        output = rasterizer.render(gaussians, CASE.camera(), 3, background, absolute_gradient=True)
        value = loss(output.image, target)[0]
        value.backward()
    # the numbers of the camera, from page-locked memory on a GPU
    assert watch.waits == ["aten._to_copy.default"]
    assert watch.operations > 20
    assert Answer.asked == 1
    assert gaussians.means.grad.shape == gaussians.means.shape
    assert [launch.name for launch in launches].count("composite") == 1
    with Watch() as watch, pytest.raises(RuntimeError, match="meta"):
        value.item()
    with Watch() as watch:
        torch.zeros(3).to("meta")
    assert len(watch.waits) == 1
