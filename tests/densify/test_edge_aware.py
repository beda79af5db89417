"""Improved-GS: scores, draws, growth control and the prunings around them, against restatements in numpy."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsbench.densify import EdgeAware
from gsbench.densify.scores import draw
from tests.densify import restatement
from tests.densify.test_long_axis import halves
from tests.densify.test_rounds import EXTENT, assert_same, observe, prepared, to_rows
from tests.densify.test_scores import COUNT, Room, alphas, at, find_edges, over_mean, started


def opacity(row: restatement.Row) -> float:
    return 1 / (1 + np.exp(-row["opacity_logits"]))


def expected_scores(gaussians: object, views: list[int]) -> np.ndarray:
    room, total = Room(), np.zeros(COUNT)
    for view in views:
        weights = alphas(gaussians, room.cameras[view])  # type: ignore[arg-type]
        total += over_mean((weights * find_edges(room.images[view])).sum((1, 2))) / len(views)
    return total


@pytest.mark.parametrize(("step", "views"), [(700, 2), (3400, 3), (6400, 3), (9400, 2)])
def test_the_edge_aware_score_of_each_gaussian(step: int, views: int) -> None:
    """The mean over the views drawn, each over its own mean; 400 iterations after the first two resets, over all."""
    densifier = EdgeAware(score_views=2)
    trainable, _ = started(densifier, step)
    with torch.no_grad():
        scores = densifier.scores(trainable.values, step, torch.Generator().manual_seed(step))
    drawn = torch.randperm(3, generator=torch.Generator().manual_seed(step))[:views].tolist()
    np.testing.assert_allclose(scores, expected_scores(trainable.values.detach(), drawn), rtol=1e-6, atol=1e-9)


def test_in_the_last_500_iterations_the_score_is_the_gradient_and_more_are_candidates() -> None:
    densifier = EdgeAware(gradient_threshold=3e-4)
    trainable, gradient = started(densifier, 0)
    for step, threshold in ((14_500, 3e-4), (14_600, 2e-4)):
        over, _ = densifier.candidates(at(step, trainable, torch.Generator()))
        np.testing.assert_array_equal(over, gradient >= threshold)
    np.testing.assert_allclose(densifier.scores(trainable.values, 14_600, torch.Generator()), gradient)
    full = EdgeAware(gradient_threshold=3e-4, max_gaussians=COUNT)
    trainable, _ = started(full, 0)
    over, _ = full.candidates(at(14_600, trainable, torch.Generator()))
    np.testing.assert_array_equal(over, gradient >= 3e-4)  # no room: the threshold stays


@pytest.mark.parametrize("step", [600, 3100, 14_900])
@pytest.mark.parametrize("seed", range(2))
def test_edge_aware_round(seed: int, step: int) -> None:
    """Who is drawn becomes two halves along the longest axis; the faint go but in the last round, the huge stay."""
    densifier = EdgeAware(gradient_threshold=3e-4, max_gaussians=COUNT + 9, cap="hard")
    trainable, gradient = started(densifier, seed)
    trainable.values.opacity_logits.data[3] = -9.0
    rows = to_rows(trainable)
    event = densifier.refine(step, trainable, torch.Generator().manual_seed(seed))
    over = gradient >= (2e-4 if step > 14_500 else 3e-4)
    assert event.split_gradient == 9
    assert event.blocked_by_cap == over.sum() - 9
    rng = torch.Generator().manual_seed(seed)
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
    assert max(np.exp(row["log_scales"]).max() for row in kept) > 0.1 * EXTENT
    assert event.balances()


def test_a_candidate_that_covers_no_edge_is_not_split_though_there_is_room() -> None:
    densifier = EdgeAware(gradient_threshold=1e-9, max_gaussians=10 * COUNT, cap="hard", prune_opacity=0.0)
    trainable, gradient = started(densifier, 1)
    scores = expected_scores(trainable.values.detach(), [0, 1, 2])
    assert 0 < (scores == 0).sum() < COUNT
    event = densifier.refine(700, trainable, torch.Generator().manual_seed(0))
    assert event.split_gradient == ((scores > 0) & (gradient >= 1e-9)).sum()
    assert event.blocked_by_cap == ((scores == 0) & (gradient >= 1e-9)).sum()


@pytest.mark.parametrize("room", [0, 9])
def test_where_nothing_can_grow_no_view_is_rendered(room: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without room all candidates are told as blocked; without candidates none is."""
    densifier = EdgeAware(max_gaussians=COUNT + room, cap="hard")
    trainable, _ = started(densifier, 0)
    monkeypatch.delattr(EdgeAware, "scores")
    candidates = torch.zeros(COUNT, dtype=torch.bool)
    candidates[: 0 if room else 5] = True
    chosen, blocked = densifier.choose(at(600, trainable, torch.Generator()), candidates, 1)
    assert not chosen.any()
    assert blocked == candidates.sum()


def test_the_growth_control_is_a_root() -> None:
    densifier = EdgeAware(max_gaussians=10_000, start=500, stop=15_000)
    trainable, _ = started(densifier, 0)
    rng = torch.Generator()
    allowed = [densifier.allowance(at(step, trainable, rng)) for step in (600, 7500, 14_500, 14_900)]
    assert allowed == [int(10_000 * np.sqrt(x)) - COUNT for x in (100 / 14_000, 0.5, 1, 1)]
    densifier.max_gaussians = COUNT
    assert densifier.allowance(at(7500, trainable, rng)) == 0
    event = densifier.refine(7500, trainable, rng)
    assert event.split_gradient == 0
    assert event.blocked_by_cap > 0


def test_the_prunings_of_the_schedule() -> None:
    """At iteration 300 below .02; at 3,300 and 6,300, after the round, the faintest fifth; resets go to .05."""
    densifier, events = EdgeAware(max_gaussians=60), {}
    for step in (299, 300, 3000, 3200, 3300, 6300, 9300, 12_300, 15_300):
        trainable, _ = prepared(densifier, 2)
        rows = to_rows(trainable)
        densifier.statistics["gradient_sum"].zero_()  # nobody grows
        event = events[step] = densifier.refine(step, trainable, torch.Generator())
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


def test_gradients_are_gathered_from_iteration_500_on() -> None:
    densifier = EdgeAware()
    trainable, _ = prepared(densifier, 0)  # shows it iterations 1 to 3
    assert not densifier.statistics["visible_count"].any()
    observe(densifier, trainable, np.random.default_rng(0), 501)
    assert densifier.statistics["visible_count"].any()
