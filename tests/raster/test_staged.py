"""Code that executors share: checks of inputs, asynchronous reads, and the node in autograd."""

import math
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
import torch
from torch import Tensor

from gsbench.raster import staged
from gsbench.raster.base import Footprint
from gsbench.raster.staged import (
    Gradients,
    Readback,
    StagedRasterizer,
    bad_values,
    check_inputs,
    check_settings,
    raise_for_values,
)
from gsbench.scene.types import Camera
from tests.gaussians.helpers import leaves, random_gaussians

BLACK = torch.zeros(3, dtype=torch.float64)


def camera(width=4, height=3, **others):
    values = {"fx": float(width), "fy": float(height), "cx": width / 2, "cy": height / 2} | others
    return Camera(width, height, **values, rotation=np.eye(3), translation=np.zeros(3))


class Recording(StagedRasterizer[str]):
    """Stages that render nothing: alpha is 1/4 everywhere, and gradients are constant."""

    name = "recording"
    extras: ClassVar = {"five": (5,)}

    def __init__(self):
        self.calls = []

    def check(self, gaussians):
        if len(gaussians) == 1:
            raise ValueError("one is too few")

    def forward(self, gaussians, request):
        alpha = torch.full((request.camera.height, request.camera.width), 0.25, dtype=torch.float64)
        image = alpha.unsqueeze(-1).repeat(1, 1, 3)
        return image, alpha, torch.ones(len(gaussians), dtype=torch.int32), "frame"

    def backward(self, *arguments):
        self.calls.append(arguments)
        _, gaussians, request, *_ = arguments
        extra = None
        if request.extra is not None:
            extra = torch.full((len(gaussians), 5), 8.0, dtype=torch.float64)
        sixes = [torch.full_like(tensor, 6.0) for tensor in gaussians.tensors().values()]
        return Gradients(sixes, torch.full((len(gaussians), 2), 7.0, dtype=torch.float64), extra)

    def footprint(self, *arguments):
        self.calls.append(arguments)
        return Footprint(*[torch.zeros(2)] * 4)


def rendered(view=None, background=BLACK, **options):
    """The calls of stages by a render, its parameters and its output."""
    rasterizer, own = Recording(), leaves(random_gaussians(2))
    return rasterizer.calls, own, rasterizer.render(own, view or camera(), 1, background, **options)


def test_gradients_reach_the_backward_stage_and_its_results_the_parameters():
    background = BLACK.clone().requires_grad_()
    calls, own, output = rendered(background=background, absolute_gradient=True, extra="five")
    assert not output.radii.requires_grad
    (2 * output.image).sum().backward()
    ((frame, given, request, g_image, g_alpha),) = calls
    assert (frame, g_alpha, request.extra, request.degree) == ("frame", None, "five", 1)
    assert torch.equal(given.means, own.means)
    assert request.absolute is output.screen_gradient_abs
    assert g_image.is_contiguous()
    assert (g_image == 2).all()
    assert all((tensor.grad == 6).all() for tensor in own.tensors().values())
    assert (output.screen_points.grad == 7).all()
    assert (output.require_extra() == 8).all()
    assert background.grad.tolist() == [2 * 12 * 0.75] * 3


def test_alpha_may_be_differentiated_without_the_image():
    calls, _, output = rendered()
    output.alpha.sum().backward()
    ((_, _, request, g_image, g_alpha),) = calls
    assert torch.equal(g_image, torch.zeros(3, 4, 3))
    assert (g_alpha == 1).all()
    assert g_alpha.is_contiguous()
    assert request.extra is request.absolute is None


def test_the_footprint_stage_gets_the_frame_and_the_values():
    calls, _, output = rendered(view := camera())
    values = torch.ones(3, 4)
    output.require_footprint(values)
    ((frame, given, request, passed),) = calls
    assert frame == "frame"
    assert not given.means.requires_grad
    assert request.camera is view
    assert passed is values


TWO = random_gaussians(2)


@pytest.mark.parametrize(
    "changes, said",
    [
        ({"view": camera(16385)}, "camera: width is 16385 px, more than 16384"),
        ({"view": camera(4, 16385)}, "camera: height is 16385 px, more than 16384"),
        ({"view": camera(fx=0.0039)}, "camera: fx is 0.0039 px"),
        ({"view": camera(fx=4.1e6)}, "camera: fx is 4100000.0 px"),
        ({"view": camera(fy=0.0029)}, "camera: fy is 0.0029 px"),
        ({"view": camera(fy=3.1e6)}, "camera: fy is 3100000.0 px"),
        ({"view": camera(cx=400.1)}, "camera: cx is 400.1 px"),
        ({"view": camera(cy=-300.1)}, "camera: cy is -300.1 px"),
        ({"degree": -1}, "sh_degree: must be 0 to 3, got -1"),
        ({"of": TWO.map(Tensor.half)}, r"dtype must be float32 or float64, got torch\.float16"),
        ({"background": BLACK.to("meta")}, r"background: is torch\.float64 on meta, but means is"),
        ({"background": BLACK.new_zeros(4)}, r"background: must be three numbers, got shape \(4,"),
        ({"background": BLACK + math.inf}, "background: must be three finite numbers"),
    ],
)
def test_an_error_names_the_setting_that_does_not_fit(changes, said):
    settings = {"of": TWO, "view": camera(), "degree": 0, "background": BLACK}
    with pytest.raises(ValueError, match=said):
        check_settings(*(settings | changes).values())


def test_the_largest_settings_are_accepted():
    for degree in (0, 3):
        check_settings(TWO, camera(16384, 16384), degree, BLACK)
    check_settings(TWO, camera(cx=400.0, cy=-300.0, fx=0.004, fy=3e6), 0, BLACK)
    # values on a device are not read
    check_settings(TWO.map(lambda tensor: tensor.to("meta")), camera(), 0, BLACK.to("meta"))


@pytest.mark.parametrize(
    "name, value, said",
    [
        *((name, math.nan, "not finite") for name in ("means", "opacity_logits", "sh_rest")),
        ("quaternions", 1e-13, "length 0"),
    ],
)
def test_the_first_gaussian_with_a_bad_value_is_named(name, value, said):
    gaussians = random_gaussians(5)
    assert not bad_values(gaussians, BLACK)
    raise_for_values(gaussians, BLACK)
    getattr(gaussians, name)[[2, 4]] = value
    assert bad_values(gaussians, BLACK)
    for refuse, more in ((raise_for_values, ()), (check_inputs, (camera(), 0, BLACK))):
        with pytest.raises(ValueError, match=rf"^{name}: {said} at Gaussian 2 \(2 in all\)"):
            refuse(gaussians, *more)


def test_a_bad_background_is_named_and_no_gaussians_are_good():
    assert bad_values(TWO, BLACK + math.nan)
    with pytest.raises(ValueError, match="background"):
        raise_for_values(TWO, BLACK + math.nan)
    assert not bad_values(TWO.select(torch.zeros(0, dtype=torch.long)), BLACK)


class Event:
    """A stand-in for a CUDA event, which completes only when ``synchronize`` is called."""

    def __init__(self):
        self.recorded = None
        self.happened = False

    def record(self, stream):
        self.recorded = stream

    def query(self):
        return self.happened

    def synchronize(self):
        assert self.recorded == "stream of cuda:1"
        self.happened = True


def test_a_readback_waits_only_if_its_copy_has_not_arrived(monkeypatch):
    host = SimpleNamespace(copied=[])
    host.copy_ = lambda source, non_blocking: host.copied.append((source, non_blocking))
    device = SimpleNamespace(type="cuda", index=1)
    source = SimpleNamespace(device=device, shape=(2,), dtype=torch.float32)
    source.detach = lambda: source
    monkeypatch.setattr(
        staged.torch, "empty", lambda *_, **options: host if options["pin_memory"] else None
    )
    monkeypatch.setattr(staged.torch.cuda, "Event", Event)
    monkeypatch.setattr(
        staged.torch.cuda, "current_stream", lambda of: f"stream of cuda:{of.index}"
    )
    monkeypatch.setattr(Readback, "waits", 0)
    early, late = Readback(source), Readback(source)
    assert host.copied == [(source, True)] * 2
    assert not early.arrived
    event = early._event
    assert early.values() is host
    assert event.happened  # it has waited
    assert early.arrived
    assert early.values() is host
    assert Readback.waits == 1
    late._event.happened = True
    assert late.arrived
    late.values()
    assert Readback.waits == 1


def test_a_readback_from_the_cpu_never_waits():
    readback = Readback(torch.ones(2, requires_grad=True))
    assert readback.arrived
    assert readback.values().tolist() == [1, 1]
