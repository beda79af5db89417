"""The proof of direct steps: they must give the bits of steps with autograd on the user's GPU."""

from __future__ import annotations

import torch

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
    for extended in (False, True):
        expected = _train(rasterizer, device, case, extended)
        for graphs in (False, True) if device.type == "cuda" else (False,):
            name = f"{'extended ' if extended else ''}{'recorded' if graphs else 'direct'} steps"
            try:
                found = _train(rasterizer, device, case, extended, graphs)
            except torch.OutOfMemoryError:
                raise
            except (RuntimeError, ValueError) as error:
                first, *_ = str(error).strip().splitlines() or [""]
                return f"{name} fail: {type(error).__name__}: {first}"
            for parameter, tensor in expected.tensors().items():
                if not torch.equal(tensor, getattr(found, parameter)):
                    return f"{parameter} has other bits after {STEPS} {name} than with autograd"
    return ""


def _train(
    rasterizer: TritonRasterizer,
    device: torch.device,
    case: Case,
    extended: bool,
    graphs: bool | None = None,
) -> Gaussians:
    """The Gaussians after all steps: with autograd (None), or direct ones, recorded or not."""
    initial = case.gaussians().map(lambda tensor: tensor.to(device, torch.float32))
    model = TrainableGaussians(initial, LearningRates(), 1.0, TritonAdam())
    numbers = torch.arange(case.height * case.width * 3, device=device) * 37 % 256
    target = numbers.to(torch.uint8).view(case.height, case.width, 3)  # as no render
    mask = target[..., :1] > 99 if extended else None
    black, loss, camera = torch.zeros(3, device=device), TritonLoss(SSIM_WEIGHT), case.camera()
    direct = DirectStep(rasterizer, loss, black, bool(graphs), visible_only=extended)
    for step in range(1, STEPS + 1):
        model.set_step(step)
        term = model.values.opacities.mean() + model.values.scales.mean() if extended else None
        if graphs is None:
            render = rasterizer.render(model.values, camera, case.sh_degree, black)
            loss(replace_ignored(render.image, target, mask), target)[0].backward()
            if term is not None:
                term.backward()
            model.optimizer_step(case.sh_degree, render.visible if extended else None)
            continue
        if step == CRAMPED_STEP:
            direct.limit_room(Room(1, 1))
        direct.step(model, camera, target, case.sh_degree, False, None, mask, term)
        direct.optimize(model)
        if step == CRAMPED_STEP and direct.repeats == 0:
            raise RuntimeError("lists without room were not noticed")
    if direct.graphs != bool(graphs):
        raise RuntimeError("CUDA refuses to record steps")
    return model.values.detach()
