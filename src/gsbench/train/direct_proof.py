"""The proof of direct steps: they must give the bits of steps with autograd on the user's GPU."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from gsbench.eval.images import replace_ignored
from gsbench.gaussians.model import Gaussians
from gsbench.gaussians.paper_values import LearningRates
from gsbench.gaussians.trainable import TrainableGaussians
from gsbench.raster import Rasterizer
from gsbench.raster.contract import Case
from gsbench.raster.triton.executor import TritonRasterizer
from gsbench.raster.triton.lists import Room
from gsbench.train.adam_triton import TritonAdam
from gsbench.train.direct import DirectStep
from gsbench.train.loss import SSIM_WEIGHT
from gsbench.train.loss_triton import TritonLoss

STEPS = 6
CRAMPED_STEP = 4  # the step before which lists lose their room, so that the render is repeated


def direct_fault(rasterizer: Rasterizer, device: torch.device, case: Case) -> str:
    """Train ``case`` for six steps in three ways; return how they differ, "" if they do not.

    The ways are autograd, direct steps launched one by one and, on a GPU, direct steps recorded as
    CUDA graphs. All parameters must have the same bits after the last step. Then the same with a
    mask, a regulariser, and Adam of visible Gaussians only.
    """
    if not isinstance(rasterizer, TritonRasterizer):
        return ""
    return _fault(rasterizer, device, case, False) or _fault(rasterizer, device, case, True)


def _fault(rasterizer: TritonRasterizer, device: torch.device, case: Case, extended: bool) -> str:
    expected = _train(device, case, partial(_with_autograd, rasterizer, case, extended))
    for graphs in (False, True) if device.type == "cuda" else (False,):
        name = ("extended " if extended else "") + ("recorded steps" if graphs else "direct steps")
        try:
            found = _train(device, case, partial(_direct, rasterizer, case, extended, graphs))
        except torch.OutOfMemoryError:
            raise
        except (RuntimeError, ValueError) as error:
            first, *_ = str(error).strip().splitlines() or [""]
            return f"{name} fail: {type(error).__name__}: {first}"
        for parameter, tensor in expected.tensors().items():
            if not torch.equal(tensor, getattr(found, parameter)):
                return f"{parameter} has other bits after {STEPS} {name} than with autograd"
    return ""


Step = Callable[[int], None]  # makes one step


def _train(
    device: torch.device, case: Case, stepper: Callable[[TrainableGaussians], Step]
) -> Gaussians:
    initial = case.gaussians().map(lambda tensor: tensor.to(device, torch.float32))
    model = TrainableGaussians(initial, LearningRates(), 1.0, TritonAdam())
    make = stepper(model)
    for step in range(1, STEPS + 1):
        model.set_step(step)
        make(step)
    return model.values.detach()


def _target(case: Case, device: torch.device) -> Tensor:
    """A picture [H, W, 3] uint8 that no render has."""
    numbers = torch.arange(case.height * case.width * 3, device=device) * 37 % 256
    return numbers.to(torch.uint8).view(case.height, case.width, 3)


def _regularizer(model: TrainableGaussians) -> Tensor:
    return model.values.opacities.mean() + model.values.scales.mean()


def _with_autograd(
    rasterizer: TritonRasterizer, case: Case, extended: bool, model: TrainableGaussians
) -> Step:
    loss, target = TritonLoss(SSIM_WEIGHT), _target(case, model.device)
    black, mask = torch.zeros(3, device=model.device), target[..., :1] > 99 if extended else None

    def step(_: int) -> None:
        render = rasterizer.render(model.values, case.camera(), case.sh_degree, black)
        loss(replace_ignored(render.image, target, mask), target)[0].backward()
        if extended:
            _regularizer(model).backward()
        model.optimizer_step(case.sh_degree, render.visible if extended else None)

    return step


def _direct(
    rasterizer: TritonRasterizer,
    case: Case,
    extended: bool,
    graphs: bool,
    model: TrainableGaussians,
) -> Step:
    black, target = torch.zeros(3, device=model.device), _target(case, model.device)
    direct = DirectStep(rasterizer, TritonLoss(SSIM_WEIGHT), black, graphs, visible_only=extended)
    camera, mask = case.camera(), target[..., :1] > 99 if extended else None

    def step(number: int) -> None:
        if number == CRAMPED_STEP:
            direct.limit_room(Room(1, 1))
        term = _regularizer(model) if extended else None
        direct.step(model, camera, target, case.sh_degree, False, None, mask, term)
        direct.optimize(model)
        if number == CRAMPED_STEP and direct.repeats == 0:
            raise RuntimeError("lists without room were not noticed")
        if number == STEPS and direct.graphs != graphs:
            raise RuntimeError("CUDA refuses to record steps")

    return step
