"""The contract of ``gsbench.raster.base``: every executor that runs here against the reference."""

import math

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings

from gsbench.gaussians.model import Gaussians
from gsbench.raster import EXECUTORS, create_rasterizer
from gsbench.raster.contract import (
    CASES,
    FOOTPRINT_TOLERANCE,
    departures,
    footprint_errors,
    render_with_gradients,
)
from gsbench.raster.executors import find_executor
from gsbench.raster.reference import ReferenceRasterizer
from gsbench.scene.types import Camera
from tests.gaussians.helpers import leaves
from tests.raster.strategies import extreme_gaussians


def _home(executor):
    """The type of device that an executor is made for."""
    return "cpu" if executor.runs_on("cpu") else "cuda"


def _available():
    places = {"cpu": True, "cuda": torch.cuda.is_available()}
    here = [
        executor
        for executor in EXECUTORS
        if places[_home(executor)] and not executor.obstacle(_home(executor))
    ]
    return [executor.name for executor in here]


@pytest.fixture(params=_available())
def device(request):
    return _home(find_executor(request.param))


@pytest.fixture
def rasterizer(request, device):
    name = request.node.callspec.params["device"]
    return create_rasterizer(name, torch.device(device), threads=2)


@pytest.mark.parametrize(
    "device", [name for name in _available() if name != "reference"], indirect=True
)
@pytest.mark.parametrize("case", CASES, ids=str)
def test_values_and_gradients_match_the_reference(rasterizer, device, case):
    """Tests in ``test_executors.py`` show that `departures` finds each kind of departure."""
    assert departures(rasterizer, device, (case,)) == []
    expected, references = render_with_gradients(ReferenceRasterizer(), case, torch.float64)
    output, gradients = render_with_gradients(rasterizer, case, torch.float32, device)
    assert torch.equal(output.radii.cpu(), expected.radii)
    assert expected.visible.sum() > case.count / 4
    for name, reference in references.items():  # if all were 0, nothing was compared
        if not (name == "sh_rest" and case.sh_degree == 0):
            assert reference.abs().max() > 0, name
    assert tuple(rasterizer.extras) == tuple(ReferenceRasterizer.extras)
    assert gradients.keys() >= {*rasterizer.extras}
    # here the footprint is computed after the backward pass
    assert max(footprint_errors(output, expected).values()) < FOOTPRINT_TOLERANCE


def test_the_gradient_of_the_colour_clamp_passes_at_zero(rasterizer, device):
    """The colour is max(0, SH + 0.5): no gradient below 0, the whole gradient at exactly 0."""
    gaussians = _one_gaussian(device)
    c0 = math.sqrt(1 / (4 * math.pi))
    at_zero = np.float32(-0.5) / np.float32(c0)
    candidates = [
        at_zero,
        np.nextafter(at_zero, np.float32(0)),
        np.nextafter(at_zero, np.float32(-9)),
    ]
    exact = next(float(v) for v in candidates if np.float32(c0) * v + np.float32(0.5) == 0)
    gaussians.sh_dc = torch.tensor(
        [[exact, exact - 1e-3, exact + 1e-3]], device=device, requires_grad=True
    )
    output = rasterizer.render(gaussians, _camera(32, 32), 0, torch.zeros(3, device=device))
    output.image.sum().backward()
    gradient = gaussians.sh_dc.grad[0]
    assert gradient[1] == 0
    assert gradient[2] > 0
    assert gradient[0].item() == pytest.approx(gradient[2].item(), rel=1e-5)


def test_without_visible_gaussians_the_image_is_the_background(rasterizer, device):
    background = torch.tensor([0.1, 0.2, 0.3], device=device)
    for one in (
        _one_gaussian(device, z=-5.0),
        _one_gaussian(device).select(torch.zeros(0, dtype=torch.long)),
    ):
        own = leaves(one)
        output = rasterizer.render(own, _camera(20, 17), 3, background)
        assert torch.equal(output.image, background.expand(17, 20, 3))
        assert output.alpha.abs().max() == 0
        assert not output.visible.any()
        assert not output.footprint(torch.ones(17, 20, device=device)).values.any()
        output.image.sum().backward()
        for name, tensor in own.tensors().items():
            assert tensor.grad is None or tensor.grad.abs().sum() == 0, name


@settings(
    max_examples=60,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(gaussians=extreme_gaussians())
def test_extreme_gaussians_give_finite_results(rasterizer, device, gaussians):
    own, background = leaves(gaussians, device), torch.zeros(3, device=device)
    output = rasterizer.render(
        own, _camera(37, 21), 3, background, absolute_gradient=True, extra="splitting_matrix"
    )
    assert output.image.isfinite().all()
    assert ((output.alpha >= 0) & (output.alpha <= 1)).all()
    assert (output.radii >= 0).all()
    (output.image.sum() + output.alpha.sum()).backward()
    assert output.screen_gradient_abs.isfinite().all()
    others = {"screen_points": output.screen_points, "extra": output.extra}
    for name, tensor in (own.tensors() | others).items():
        assert tensor.grad is None or tensor.grad.isfinite().all(), name


@pytest.mark.parametrize(
    "name", ["means", "log_scales", "quaternions", "opacity_logits", "sh_dc", "sh_rest"]
)
@pytest.mark.parametrize("value", [math.nan, -math.inf, 0.0])
def test_an_error_names_the_parameter_that_is_not_finite(rasterizer, device, name, value):
    gaussians = _one_gaussian(device)
    getattr(gaussians, name).flatten()[0] = value
    if value or name == "quaternions":  # of length zero
        with pytest.raises(ValueError, match=name):
            rasterizer.render(gaussians, _camera(16, 16), 3, torch.zeros(3, device=device))


def test_an_error_names_the_input_that_cannot_be_used(rasterizer, device):
    """Tests in ``test_staged.py`` show every such error."""
    for word, degree, of_background in (("sh_degree", 4, 0.0), ("background", 0, math.nan)):
        background = torch.full((3,), of_background, device=device)
        with pytest.raises(ValueError, match=word):
            rasterizer.render(_one_gaussian(device), _camera(16, 16), degree, background)


def _camera(width, height):
    return Camera(width, height, width, width, width / 2, height / 2, np.eye(3), np.zeros(3))


def _one_gaussian(device, z=3.0):
    gaussians = Gaussians(
        torch.tensor([[0.0, 0.0, z]]),
        torch.full((1, 3), -1.0),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        torch.ones(1),
        torch.zeros(1, 3),
        torch.zeros(1, 15, 3),
    )
    return gaussians.map(lambda tensor: tensor.to(device))
