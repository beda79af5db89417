"""Improved-GS and GNS against restatements, one Gaussian at a time."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from gsbench.densify import GNS, DensifyContext, EdgeAware, LongAxis
from gsbench.densify.scores import draw
from tests.densify import restatement
from tests.densify.helpers import (
    EXTENT,
    Round,
    around_a_reset,
    assert_same,
    at,
    gathered,
    generator,
    to_rows,
)
from tests.densify.restatement import opacity
from tests.densify.test_rounds import prepared
from tests.densify.test_scores import COUNT, Room, alphas, find_edges, over_mean, started
from tests.gaussians.helpers import random_gaussians


def halves(rows, mean_gradient):
    """Replace Gaussians with a gradient of at least 0.0008 by two halves along the longest axis.

    With d = 0.45, the centres are 3 d s from the parent's. The longest axis is multiplied by 0.55,
    the others by sqrt(1 - 0.2025).
    """
    chosen = [i for i in range(len(rows)) if mean_gradient[i] >= 0.0008]
    sizes = 1.35, 0.55, 0.7975**0.5
    return restatement.halve_all(
        rows, chosen, lambda i, side: restatement.half(rows[i], side, *sizes)
    )


@around_a_reset
@pytest.mark.parametrize("seed", range(3))
def test_a_round_of_long_axis_matches_the_restatement(seed, step):
    densifier = LongAxis()
    trainable, _ = prepared(densifier, seed)
    gradient = np.random.default_rng(seed).uniform(0, 0.0016, len(trainable))
    gathered(densifier, gradient)
    real = Round(densifier, trainable, step)
    grown = halves(real.rows, gradient)
    assert real.event.split_gradient == len(grown) - len(real.rows) > 0
    assert real.event.cloned == 0
    real.check(grown)


def expected_scores(gaussians, views):
    room, total = Room(), np.zeros(COUNT)
    for view in views:
        weights = alphas(gaussians, room.cameras[view])
        total += over_mean((weights * find_edges(room.images[view])).sum((1, 2))) / len(views)
    return total


@pytest.mark.parametrize("step, views", [(700, 2), (3400, 3), (6400, 3), (9400, 2)])
def test_edge_aware_scores_match_the_restatement(step, views):
    """A score is the mean over the drawn views, each normalised by its own mean.

    400 iterations after the first two resets, all views are used.
    """
    densifier = EdgeAware(score_views=2)
    trainable, _ = started(densifier, step)
    with torch.no_grad():
        scores = densifier.scores(trainable.values, step, generator(step))
    drawn = torch.randperm(3, generator=generator(step))[:views].tolist()
    assert_allclose(scores, expected_scores(trainable.values.detach(), drawn), rtol=1e-6, atol=1e-9)


def test_in_the_last_500_iterations_the_score_is_the_gradient_and_the_threshold_is_lower():
    densifier = EdgeAware(gradient_threshold=3e-4)
    trainable, gradient = started(densifier, 0)
    for step, threshold in ((14_500, 3e-4), (14_600, 2e-4)):
        over, _ = densifier.candidates(at(step, trainable))
        assert_array_equal(over, gradient >= threshold)
    assert_allclose(densifier.scores(trainable.values, 14_600, generator()), gradient)
    full = EdgeAware(gradient_threshold=3e-4, max_gaussians=COUNT)
    trainable, _ = started(full, 0)
    over, _ = full.candidates(at(14_600, trainable))
    assert_array_equal(over, gradient >= 3e-4)  # no room: the threshold is not lowered


@pytest.mark.parametrize("step", [600, 3100, 14_900])
@pytest.mark.parametrize("seed", range(2))
def test_a_round_of_edge_aware_matches_the_restatement(seed, step):
    """Drawn Gaussians are replaced by halves along the longest axis.

    Faint Gaussians are pruned except in the last round; huge ones are kept.
    """
    densifier = EdgeAware(gradient_threshold=3e-4, max_gaussians=COUNT + 9, cap="hard")
    trainable, gradient = started(densifier, seed)
    trainable.values.opacity_logits.data[3] = -9.0
    rows = to_rows(trainable)
    event = densifier.refine(step, trainable, generator(seed))
    over = gradient >= (2e-4 if step > 14_500 else 3e-4)
    assert event.split_gradient == 9
    assert event.blocked_by_cap == over.sum() - 9
    rng = generator(seed)
    with torch.no_grad():
        twin, _ = started(densifier, seed)
        twin.values.opacity_logits.data[3] = -9.0
        scores = densifier.scores(twin.values, step, rng)
    drawn = draw(torch.from_numpy(over) & (scores > 0), scores, 9, rng).numpy()
    assert not (drawn & ~over).any()
    grown = halves(rows, np.where(drawn, 1.0, 0.0))
    kept = [row for row in grown if step == 14_900 or opacity(row) >= 0.005]
    assert_same(trainable, kept)
    assert (event.pruned_opacity, event.pruned_size) == (len(grown) - len(kept), 0)
    assert (len(kept) < len(grown)) == (step != 14_900)
    assert max(restatement.size(row) for row in kept) > 0.1 * EXTENT
    assert event.balances()


def test_a_candidate_that_covers_no_edge_is_not_split_even_if_there_is_room():
    densifier = EdgeAware(
        gradient_threshold=1e-9, max_gaussians=10 * COUNT, cap="hard", prune_opacity=0.0
    )
    trainable, gradient = started(densifier, 1)
    scores = expected_scores(trainable.values.detach(), [0, 1, 2])
    assert 0 < (scores == 0).sum() < COUNT
    event = densifier.refine(700, trainable, generator(0))
    assert event.split_gradient == ((scores > 0) & (gradient >= 1e-9)).sum()
    assert event.blocked_by_cap == ((scores == 0) & (gradient >= 1e-9)).sum()


@pytest.mark.parametrize("room", [0, 9])
def test_no_view_is_rendered_if_nothing_can_grow(room, monkeypatch):
    """Without room, all candidates count as blocked; without candidates, none does."""
    densifier = EdgeAware(max_gaussians=COUNT + room, cap="hard")
    trainable, _ = started(densifier, 0)
    monkeypatch.delattr(EdgeAware, "scores")
    candidates = torch.zeros(COUNT, dtype=torch.bool)
    candidates[: 0 if room else 5] = True
    chosen, blocked = densifier.choose(at(600, trainable), candidates, 1)
    assert not chosen.any()
    assert blocked == candidates.sum()


def test_the_root_cap_rises_with_the_square_root_of_the_progress():
    densifier = EdgeAware(max_gaussians=10_000, start=500, stop=15_000)
    trainable, _ = started(densifier, 0)
    rng = generator()
    allowed = [densifier.allowance(at(step, trainable)) for step in (600, 7500, 14_500, 14_900)]
    assert allowed == [int(10_000 * np.sqrt(x)) - COUNT for x in (100 / 14_000, 0.5, 1, 1)]
    # a window shorter than the closing rounds
    short = EdgeAware(max_gaussians=1000, start=100, stop=400, interval=100)
    assert [short.limit(step) for step in (150, 200, 300)] == [707, 1000, 1000]
    densifier.max_gaussians = COUNT
    assert densifier.allowance(at(7500, trainable)) == 0
    event = densifier.refine(7500, trainable, rng)
    assert event.split_gradient == 0
    assert event.blocked_by_cap > 0


def test_edge_aware_prunes_once_early_and_after_two_resets():
    """At iteration 300, opacities below 0.02 are pruned.

    At 3,300 and 6,300, the faintest fifth is pruned after the round. Resets lower opacities to
    0.05.
    """
    densifier, events = EdgeAware(max_gaussians=60), {}
    for step in (299, 300, 3000, 3200, 3300, 6300, 9300, 12_300, 15_300):
        trainable, _ = prepared(densifier, 2)
        rows = to_rows(trainable)
        densifier.statistics["gradient_sum"].zero_()  # nothing grows
        event = events[step] = densifier.refine(step, trainable, generator())
        if step == 3000:
            assert max(opacity(row) for row in to_rows(trainable)) == pytest.approx(0.05)
            continue
        if step == 300:
            rows = [row for row in rows if opacity(row) >= 0.02]
        elif event is not None:
            rows = [row for row in rows if opacity(row) >= 0.005]
            if step in (3300, 6300):
                fifth = np.quantile([opacity(row) for row in rows], 0.2)
                rows = [row for row in rows if opacity(row) >= fifth]
        assert_same(trainable, rows)
        assert event is None or (event.balances() and event.after == len(rows) < event.before)
    assert [step for step, event in events.items() if event is None] == [299, 15_300]


def begun(**options):
    densifier, gaussians = GNS(**options), random_gaussians(50, 1)
    gaussians.opacity_logits.copy_(torch.linspace(-6, 5, 50, dtype=torch.float64))
    densifier.begin(gaussians, DensifyContext(4.0))
    return densifier, gaussians


def restated(densifier, logits, weight, soft):
    if not soft:
        return 3 * weight * (logits.mean() + 20) ** 2
    opacities = 1 / (1 + np.exp(-logits))
    return weight * ((logits + 20) / np.maximum(0.05, 1 - opacities)).mean() ** 2


@pytest.mark.parametrize(
    "step, soft", [(15_001, True), (15_951, True), (16_001, False), (22_951, False)]
)
def test_the_pressure_and_its_gradient_match_the_formula(step, soft):
    """Central differences show that the gradient also flows through the divisor."""
    densifier, gaussians = begun(max_gaussians=20)
    densifier.step = step - 1
    gaussians.opacity_logits.requires_grad_()
    term = densifier.regularizer(gaussians)
    logits = gaussians.opacity_logits.detach().numpy()
    assert term.item() == pytest.approx(restated(densifier, logits, 2e-4, soft), rel=1e-12)
    (gradient,) = torch.autograd.grad(term, gaussians.opacity_logits)
    for i in (0, 25, 40, 49):
        moved = [logits + sign * 1e-6 * np.eye(50)[i] for sign in (1, -1)]
        up, down = (restated(densifier, m, 2e-4, soft) for m in moved)
        assert float(gradient[i]) == pytest.approx((up - down) / 2e-6, rel=1e-5)


@pytest.mark.parametrize("sinks", [0.0, 2.0])
def test_the_weight_follows_an_aim_that_falls_to_zero(sinks):
    """The schedule of the authors, iteration by iteration, for constant opacities.

    If opacities sink once after the aim is set, the weight first falls, then stays while the aim
    passes the opacity, then rises.
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


@pytest.mark.parametrize("budget, place", [(20, 19), (17, 16), (50, 49), (70, 49)])
def test_the_aim_starts_from_the_last_gaussian_within_the_budget(budget, place):
    densifier, gaussians = begun(max_gaussians=budget)
    densifier.step = 15_000
    densifier.regularizer(gaussians)
    assert densifier.aim == pytest.approx(
        0.8 * sorted(gaussians.opacities.tolist(), reverse=True)[place]
    )


def test_gns_grows_to_three_times_the_budget_and_is_reduced_to_the_budget():
    densifier = GNS(max_gaussians=40)
    trainable, _ = started(densifier, 0)
    rng = generator(0)
    assert densifier.allowance(at(14_500, trainable)) == 120 - COUNT
    assert densifier.refine(15_000, trainable, rng) is not None  # the learning rate
    assert trainable.adam["opacity_logits"].rate == pytest.approx(4 * 0.05)
    assert densifier.refine(15_050, trainable, rng) is None
    assert densifier.refine(15_950, trainable, rng) is None  # nothing is pruned yet
    trainable.values.opacity_logits.data[:10] = -8.0  # opacity 0.0003
    event = densifier.refine(16_000, trainable, rng)
    assert (event.pruned_opacity, event.after) == (10, COUNT - 10)
    trainable.values.opacity_logits.data[:9] = -8.0
    event = densifier.refine(16_050, trainable, rng)
    assert event.after == 41
    trainable.values.opacity_logits.data[:2] = -40.0
    event = densifier.refine(16_051, trainable, rng)  # within 5 %: the rest is drawn
    assert (event.pruned_opacity, event.after) == (1, 40)
    least = trainable.values.opacities.detach().sort().values
    assert float(least[0]) < 1e-9 < float(least[1])
    assert densifier.regularizer(trainable.values) is None
    assert not any(densifier.refine(step, trainable, rng) for step in (16_100, 17_050, 23_000))
    assert trainable.adam["opacity_logits"].rate == pytest.approx(4 * 0.05)
    assert densifier.refine(17_051, trainable, rng).balances()
    assert trainable.adam["opacity_logits"].rate == pytest.approx(0.05)


def test_at_the_end_of_the_pressure_the_excess_is_removed_by_a_draw_that_favours_the_opaque(caplog):
    densifier = GNS(max_gaussians=20)
    trainable, _ = started(densifier, 0)
    trainable.values.opacity_logits.data[20:] = -30.0
    trainable.values.opacity_logits.data[:20] = 3.0
    event = densifier.refine(23_000, trainable, generator(0))
    assert (event.pruned_opacity, event.after) == (COUNT - 20, 20)
    assert trainable.values.opacity_logits.tolist() == [3.0] * 20
    assert event.balances()
    assert (
        f"ended with {COUNT} Gaussians, and {COUNT - 20} of them were removed at random"
        in caplog.text
    )


def test_a_selection_close_to_its_budget_logs_no_warning(caplog):
    densifier = GNS(max_gaussians=COUNT - 1)
    trainable, _ = started(densifier, 0)
    assert densifier.refine(16_050, trainable, generator(0)).after == COUNT - 1
    assert caplog.text == ""


def test_the_pressure_lasts_at_least_one_round():
    shortest = GNS(start=0, stop=3, interval=1, pressure_length=1e-3)
    shortest.begin(random_gaussians(3), DensifyContext(1.0))
    assert (shortest.pressure_interval, shortest.pressure_time) == (1, 1)
    assert [shortest.pressing(step) for step in (2, 3, 4, 5)] == [False, True, True, False]
    usual = GNS()
    assert (usual.pressure_interval, usual.pressure_time) == (50, 8000)
    assert [usual.in_first_part(step) for step in (15_999, 16_000)] == [True, False]
