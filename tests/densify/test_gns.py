"""GNS: the pressure against finite differences and a restatement of the schedule, and the selection to a budget."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsbench.densify import GNS, DensifyContext
from gsbench.gaussians.model import Gaussians
from gsbench.gaussians.paper_values import LearningRates
from gsbench.gaussians.trainable import TrainableGaussians
from gsbench.raster.base import RenderOutput
from tests.densify.test_scores import COUNT, at, started
from tests.gaussians.helpers import random_gaussians


def begun(**options: object) -> tuple[GNS, Gaussians]:
    densifier, gaussians = GNS(**options), random_gaussians(50, 1)  # type: ignore[arg-type]
    gaussians.opacity_logits.copy_(torch.linspace(-6, 5, 50, dtype=torch.float64))
    densifier.begin(gaussians, DensifyContext(4.0))
    return densifier, gaussians


def seen(densifier: GNS, step: int) -> None:
    points = torch.zeros(50, 2, dtype=torch.float64, requires_grad=True)
    points.grad = torch.zeros(50, 2, dtype=torch.float64)
    radii = torch.ones(50, dtype=torch.int32)
    densifier.observe(step, RenderOutput(torch.empty(0), torch.empty(0), radii, points, points.grad))


def restated(densifier: GNS, logits: np.ndarray, weight: float, soft: bool) -> float:
    if not soft:
        return 3 * weight * (logits.mean() + 20) ** 2
    opacities = 1 / (1 + np.exp(-logits))
    return weight * ((logits + 20) / np.maximum(0.05, 1 - opacities)).mean() ** 2


@pytest.mark.parametrize(("step", "soft"), [(15_001, True), (15_951, True), (16_001, False), (22_951, False)])
def test_the_pressure_and_its_gradient(step: int, soft: bool) -> None:
    """Against the formula and its central differences, also through the divisor."""
    densifier, gaussians = begun(max_gaussians=20)
    densifier.step = step - 1
    gaussians = gaussians.map(lambda tensor: tensor.clone().requires_grad_(True))
    term = densifier.regularizer(gaussians)
    assert term is not None
    logits = gaussians.opacity_logits.detach().numpy()
    assert term.item() == pytest.approx(restated(densifier, logits, 2e-4, soft), rel=1e-12)
    (gradient,) = torch.autograd.grad(term, gaussians.opacity_logits)
    for i in (0, 25, 40, 49):
        moved = [logits + sign * 1e-6 * np.eye(50)[i] for sign in (1, -1)]
        up, down = (restated(densifier, m, 2e-4, soft) for m in moved)
        assert float(gradient[i]) == pytest.approx((up - down) / 2e-6, rel=1e-5)


@pytest.mark.parametrize("sinks", [0.0, 2.0])
def test_the_weight_follows_an_aim_that_falls_to_nothing(sinks: float) -> None:
    """The authors' schedule, iteration by iteration, for opacities that stay once the first has set the aim.

    Where they sank, the weight falls first, rests while the aim passes, and rises.
    """
    densifier, gaussians = begun(max_gaussians=20)
    last = float(gaussians.opacities.sort(descending=True).values[19])
    weight, aim, acted = 2e-4, None, []
    for step in range(14_990, 23_010):
        densifier.step = step - 1
        term = densifier.regularizer(gaussians)
        if not (15_000 <= step <= 23_000 and (step - 1) % 50 == 0):
            assert term is None, step
            continue
        if aim is None:
            aim = 0.8 * last
        elif (step - 1) % 100 == 0:
            goal = max(0, (1 - (step - 15_000) / 7000) * aim)
            weight *= 0.8 if last < 0.9 * goal else 1.2 if last > 1.1 * goal else 1
        acted.append(step)
        assert densifier.weight == pytest.approx(weight, rel=1e-12)
        assert float(term) == pytest.approx(
            restated(densifier, gaussians.opacity_logits.numpy(), weight, step < 16_000), rel=1e-9
        )
        if len(acted) == 1:
            gaussians.opacity_logits.sub_(sinks)
            last = float(gaussians.opacities.sort(descending=True).values[19])
    assert acted == list(range(15_001, 23_001, 50))


@pytest.mark.parametrize(("budget", "place"), [(20, 19), (17, 16), (50, 49), (70, 49)])
def test_the_aim_starts_from_the_last_gaussian_within_the_budget(budget: int, place: int) -> None:
    densifier, gaussians = begun(max_gaussians=budget)
    densifier.step = 15_000
    densifier.regularizer(gaussians)
    assert densifier.aim == pytest.approx(0.8 * sorted(gaussians.opacities.tolist(), reverse=True)[place])


def test_it_grows_to_three_times_the_budget_and_selects_down_to_it() -> None:
    densifier = GNS(max_gaussians=40)
    trainable, _ = started(densifier, 0)
    rng = torch.Generator().manual_seed(0)
    assert densifier.allowance(at(14_500, trainable, rng)) == 120 - COUNT
    assert densifier.refine(15_000, trainable, rng) is not None  # the learning rate
    assert trainable.adam["opacity_logits"].rate == pytest.approx(4 * 0.05)
    assert densifier.refine(15_050, trainable, rng) is None
    assert densifier.refine(15_950, trainable, rng) is None  # nobody is pruned yet
    trainable.values.opacity_logits.data[:10] = -8.0  # .0003
    event = densifier.refine(16_000, trainable, rng)
    assert (event.pruned_opacity, event.after) == (10, COUNT - 10)
    trainable.values.opacity_logits.data[:9] = -8.0
    event = densifier.refine(16_050, trainable, rng)
    assert event.after == 41
    opaque = trainable.values.opacities.detach().clone()
    opaque[0] = opaque[1] = 0
    trainable.values.opacity_logits.data[:2] = -40.0
    event = densifier.refine(16_051, trainable, rng)  # within 5 %: the rest is drawn
    assert (event.pruned_opacity, event.after) == (1, 40)
    least = trainable.values.opacities.detach().sort().values
    assert float(least[0]) < 1e-9 < float(least[1])
    assert densifier.regularizer(trainable.values) is None
    assert [densifier.refine(step, trainable, rng) for step in (16_100, 17_050, 23_000)] == [None] * 3
    assert trainable.adam["opacity_logits"].rate == pytest.approx(4 * 0.05)
    assert densifier.refine(17_051, trainable, rng).balances()
    assert trainable.adam["opacity_logits"].rate == pytest.approx(0.05)


def test_at_the_end_of_its_time_the_budget_is_met_whatever_the_opacities(caplog: pytest.LogCaptureFixture) -> None:
    densifier = GNS(max_gaussians=20)
    trainable, _ = started(densifier, 0)
    event = densifier.refine(23_000, trainable, torch.Generator().manual_seed(0))
    assert (event.pruned_opacity, event.after) == (COUNT - 20, 20)
    assert event.balances()
    assert f"ended with {COUNT} Gaussians, and {COUNT - 20} of them were removed at random" in caplog.text


def test_a_selection_that_has_met_its_budget_warns_of_nothing(caplog: pytest.LogCaptureFixture) -> None:
    densifier = GNS(max_gaussians=COUNT - 1)
    trainable, _ = started(densifier, 0)
    assert densifier.refine(16_050, trainable, torch.Generator().manual_seed(0)).after == COUNT - 1
    assert caplog.text == ""


def test_the_selection_survives_saving() -> None:
    densifier, gaussians = begun(max_gaussians=20)
    for step in range(15_000, 15_200):
        densifier.regularizer(gaussians)
        seen(densifier, step)
    twin, _ = begun(max_gaussians=20)
    twin.load_state_dict(densifier.state_dict(), DensifyContext(4.0))
    for step in range(15_200, 15_400):
        first, second = (d.regularizer(gaussians) for d in (densifier, twin))
        assert (first is None) == (second is None) == ((step - 1) % 50 != 0)
        assert first is None or float(first) == float(second)  # type: ignore[arg-type]
        seen(densifier, step)
        seen(twin, step)
    assert twin.weight == densifier.weight != 2e-4


def test_the_rate_of_a_parameter_is_kept_in_its_state() -> None:
    trainable = TrainableGaussians(random_gaussians(4), LearningRates(), 1.0)
    trainable.set_rate("opacity_logits", 0.2)
    again = TrainableGaussians.load(trainable.state_dict(), LearningRates(), 1.0)
    assert again.adam["opacity_logits"].rate == 0.2
