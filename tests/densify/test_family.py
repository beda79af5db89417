"""Properties of ADC, MCMC, MRNF and the functions that densifiers share."""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from gsbench.densify import (
    ADC,
    GNS,
    MCMC,
    MRNF,
    AbsGS,
    DensifyContext,
    EdgeAware,
    FastGS,
    PixelGS,
    ResGS,
    SteepGS,
    Taming,
    Volumetric,
)
from gsbench.densify.budget import Budgeted
from gsbench.densify.mcmc import shared_opacity
from gsbench.densify.scores import faded, quantile, revised_logits
from gsbench.raster.base import Footprint
from tests.densify.helpers import generator, rendered, trained
from tests.gaussians.helpers import random_gaussians
from tests.helpers import refusal

GRADIENT = torch.tensor([[3.0, 4.0], [0.0, 0.0], [1.0, 0.0]], dtype=torch.float64)


@pytest.mark.parametrize("copies", [1, 2, 3, 8])
@pytest.mark.parametrize("opacity", [0.1, 0.6, 0.95])
def test_shared_opacity_preserves_centre_and_integral(copies, opacity):
    """n copies at one place have the opacity of the original at the centre.

    They also have the same integral of opacity along a line (computed numerically).
    """
    o = torch.tensor([opacity], dtype=torch.float64)
    new, factor = shared_opacity(o, torch.tensor([copies]))
    assert 1 - (1 - float(new)) ** copies == pytest.approx(opacity)
    x = np.linspace(-12, 12, 48_001)
    before = opacity * np.exp(-(x**2) / 2)
    after = 1 - (1 - float(new) * np.exp(-(x**2) / (2 * float(factor) ** 2))) ** copies
    assert np.trapezoid(after, x) == pytest.approx(np.trapezoid(before, x), rel=1e-6)


def test_revised_opacity_of_two_children_equals_the_parent():
    logits = torch.tensor([-4.0, 0.0, 3.0], dtype=torch.float64)
    assert_close(1 - (1 - torch.sigmoid(revised_logits(logits))) ** 2, torch.sigmoid(logits))
    assert revised_logits(torch.tensor([-40.0])).sigmoid().item() == pytest.approx(1e-6)
    assert_close(faded(logits, 0.3).sigmoid(), 0.3 * logits.sigmoid())


@pytest.mark.parametrize("share", [0.0, 0.1, 0.37, 0.5, 1.0])
def test_quantiles_are_those_of_numpy(share):
    values = np.sort(np.random.default_rng(0).normal(size=8))
    for count in (1, 2, 8):
        found = quantile(torch.from_numpy(values[:count]), share)
        assert found == pytest.approx(np.quantile(values[:count], share))


@pytest.mark.parametrize(
    "densifier, scale",
    [(MCMC(initial_opacity=0.2), 0.1), (MRNF(initial_opacity=0.2, initial_scale=3.0), 3.0)],
)
def test_mcmc_and_mrnf_start_with_small_gaussians_of_one_opacity(densifier, scale):
    initial = random_gaussians(5)
    gaussians = densifier.prepare(initial)
    assert_close(gaussians.opacities, torch.full((5,), 0.2, dtype=torch.float64))
    assert_close(gaussians.scales, scale * initial.scales)
    assert gaussians.means is initial.means


def test_mcmc_adds_mean_opacity_and_mean_scale_to_the_loss():
    gaussians = random_gaussians(5)
    term = MCMC(opacity_weight=0.3, scale_weight=0.05).regularizer(gaussians)
    assert_close(term, 0.3 * gaussians.opacities.mean() + 0.05 * gaussians.scales.mean())


@pytest.mark.parametrize(
    "most, changed, logit, counts",
    [
        (9, slice(1, 2), 0.0, (1, 1, 9)),  # only one of two stays dead
        (50, slice(None), -9.0, (0, 0, 8)),  # all are dead
    ],
)
def test_mcmc_can_move_and_add_a_single_gaussian_and_none_if_all_are_dead(
    most, changed, logit, counts
):
    densifier, trainable = mcmc_state(8, max_gaussians=most, growth=0.5)
    trainable.values.opacity_logits.data[changed] = logit
    event = densifier.refine(600, trainable, generator())
    assert (event.relocated, event.added, event.after) == counts
    assert len(trainable) == counts[-1]


def test_copies_of_an_opaque_gaussian_have_a_finite_logit():
    densifier, trainable = mcmc_state(4, max_gaussians=50, growth=5.0)
    trainable.values.opacity_logits.data[:] = 60.0
    densifier.refine(600, trainable, generator())
    assert float(trainable.values.opacities.detach().max()) == pytest.approx(1 - 1e-6, abs=1e-12)


def mcmc_state(count=40, **options):
    gaussians = random_gaussians(count)
    gaussians.opacity_logits[: count // 4] = -9.0  # dead
    densifier = MCMC(**options)
    densifier.begin(gaussians, DensifyContext(4.0))
    return densifier, trained(gaussians)


def test_mcmc_moves_dead_gaussians_and_grows_exactly_to_the_cap():
    densifier, trainable = mcmc_state(max_gaussians=50, growth=0.2)
    rng = generator(0)
    event = densifier.refine(600, trainable, rng)
    assert (event.before, event.relocated, event.added, event.after) == (40, 10, 8, 48)
    assert (trainable.values.opacities > densifier.min_opacity * 0.999).all()
    event = densifier.refine(700, trainable, rng)
    assert (event.added, event.blocked_by_cap, event.after) == (2, 7, 50)
    event = densifier.refine(800, trainable, rng)
    assert (event.added, event.blocked_by_cap, event.after) == (0, 10, 50)
    assert len(densifier.lineage.ids) == 50
    assert densifier.lineage.causes_of_living()["relocated"] > 0


def test_a_cap_below_the_initial_cloud_is_refused():
    with refusal(r"densify.max_gaussians .* initial cloud \(40\)"):
        mcmc_state(max_gaussians=39)
    with refusal(r"densify.max_gaussians .* initial cloud"):
        ADC(max_gaussians=3).begin(random_gaussians(4), DensifyContext(1.0))


@pytest.mark.parametrize("kind, total", [("absolute", [5.0, 0.0, 1.0]), ("signed", [0.0] * 3)])
def test_only_the_option_absolute_gathers_the_absolute_gradient(kind, total):
    densifier = ADC(gradient=kind)
    assert densifier.needs_absolute_gradient == (kind == "absolute")
    densifier.begin(random_gaussians(3), DensifyContext(1.0))
    densifier.observe(1, rendered(torch.zeros(3, 2), absolute=GRADIENT))
    assert densifier.statistics["gradient_sum"].tolist() == total


def seen_by_one_view():
    """A render in which the last of three Gaussians is not visible."""
    probe = torch.zeros(3, 3, 3, requires_grad=True)
    probe.grad = torch.ones(3, 3, 3)
    ones = torch.ones(3)
    covered = Footprint(ones.int(), ones, ones, ones)
    more = {"extra": probe, "footprint": lambda values=None: covered}
    return rendered(GRADIENT, radii=[3, 7, 0], absolute=GRADIENT, **more)


@pytest.mark.parametrize(
    "densifier, quiet, heard",
    [
        *((kind(), [15_000], [1, 14_999]) for kind in (ADC, AbsGS, PixelGS, SteepGS, Volumetric)),
        *((kind(), [500, 15_000], [501, 14_999]) for kind in (EdgeAware, GNS)),
        # the pauses of the authors' code: 2,501 to 2,999 and 6,001 to 6,499
        (ResGS(start=700, stop=12_000), [500, 2501, 2999, 6001], [501, 2500, 3000, 6500]),
    ],
)
def test_statistics_are_gathered_within_the_window_only(densifier, quiet, heard):
    densifier.begin(random_gaussians(3), DensifyContext(1.0))
    for step in quiet:
        densifier.observe(step, seen_by_one_view())
    assert not any(statistic.any() for statistic in densifier.statistics.values())
    for count, step in enumerate(heard, start=1):
        densifier.observe(step, seen_by_one_view())
        assert densifier.statistics["visible_count"].tolist() == [count, count, 0]
    gathered = {name for name, statistic in densifier.statistics.items() if statistic.any()}
    assert gathered == set(densifier.STATISTICS) - {"level"}


def test_mrnf_gathers_which_gaussians_were_seen():
    densifier = MRNF()
    densifier.begin(random_gaussians(3), DensifyContext(1.0))
    for radii in ([0, 0, 2], [1, 0, 0]):
        densifier.observe(1, rendered(torch.zeros(3, 2), radii=radii))
    assert densifier.statistics["seen"].tolist() == [True, False, True]


def test_the_curve_rises_from_the_initial_count_to_the_cap():
    curve = Budgeted(start=500, stop=1500, max_gaussians=1100, cap="curve")
    curve.begin(random_gaussians(100), DensifyContext(1.0))
    assert [*map(curve.limit, (0, 500, 1000, 1500, 9000))] == [100, 100, 850, 1100, 1100]
    curve.cap = "hard"
    assert curve.limit(600) == 1100


def test_a_gradient_at_the_threshold_grows_only_if_it_is_inclusive():
    counts = {}
    for inclusive in (True, False):
        densifier = ADC(threshold_inclusive=inclusive, gradient_threshold=2.5e-4)
        trainable = trained(random_gaussians(1, log_scale=(-9, -8)))
        trainable.values.opacity_logits.data.fill_(2.0)
        densifier.begin(trainable.values.detach(), DensifyContext(4.0))
        densifier.statistics["gradient_sum"][:] = torch.tensor(2.5e-4)
        densifier.statistics["visible_count"][:] = 1
        # the threshold, rounded to float32 like the gradient
        densifier.gradient_threshold = float(densifier.statistics["gradient_sum"][0])
        counts[inclusive] = densifier.refine(600, trainable, generator()).cloned
    assert counts == {True: 1, False: 0}


def test_mcmc_shares_an_opacity_among_at_most_fifty_copies():
    """The authors limit the number to 50, although their table of binomials has 51 rows."""
    densifier, trainable = mcmc_state(2, max_gaussians=200, growth=50.0)
    trainable.values.opacity_logits.data[:] = torch.tensor([-4.0, 8.0])
    opacity = float(trainable.values.opacities[1].detach())
    assert densifier.refine(600, trainable, generator(0)).added == 100
    expected = max(1 - (1 - opacity) ** (1 / 50), densifier.min_opacity)
    assert float(trainable.values.opacities[1].detach()) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(
    "kind, setting, value",
    [
        (ADC, "split_children", 65),  # would fill the memory, as the next
        (Volumetric, "volume_children", 10**9),
        (MRNF, "opacity_decay", 1),
        (MCMC, "max_copies", 52),
        (Volumetric, "volume_threshold", -1.0),
        (Volumetric, "max_condition", 0.5),
        (ADC, "interval", 0),
        (Volumetric, "volume_interval", 150),
        (ADC, "gradient_threshold", 0.0),
        (ADC, "max_gaussians", 0),
        (ADC, "stop", 10),
        (Volumetric, "threshold_mode", "banana"),
        (ResGS, "phase_ends", [0.5, 0.2]),
        *((kind, "cap", "freeze") for kind in (EdgeAware, Taming, FastGS)),
        *((kind, "cap", "governor") for kind in (EdgeAware, Taming, FastGS)),
        *((kind, "cap", "soft") for kind in (EdgeAware, Taming)),
    ],
)
def test_bad_values_are_refused_by_the_name_of_their_setting(kind, setting, value):
    with refusal(rf"densify\.{setting} must"):
        kind(**{setting: value})


def test_mrnf_accepts_an_empty_model():
    """If decay has removed all Gaussians, the trainer reports that none is left."""
    densifier, rng = MRNF(), generator()
    gaussians = trained(random_gaussians(3, seed=1), 1.0)
    densifier.begin(gaussians.values, DensifyContext(1.0))
    densifier.statistics = {"seen": torch.zeros(0, dtype=torch.bool)}
    gaussians.edit(torch.zeros(3, dtype=torch.bool))
    densifier.after_step(1, gaussians, rng)
    assert len(gaussians) == 0
