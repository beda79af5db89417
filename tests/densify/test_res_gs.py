"""ResGS against a restatement, one Gaussian at a time, and its stages against the authors' loop, step by step."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsbench.densify import Refinement, ResGS
from gsbench.errors import InputError
from tests.densify import restatement
from tests.densify.test_rounds import assert_same, observe, prepared, to_rows

WINDOW = {"start": 700, "stop": 12_000}  # of the authors


def opacity(row: restatement.Row) -> float:
    return 1 / (1 + np.exp(-row["opacity_logits"]))


def with_opacity(row: restatement.Row, value: float, moments: bool = True) -> restatement.Row:
    changed = row | {"opacity_logits": np.log(value / (1 - value))}
    return (
        changed if moments else changed | {f"{moment} opacity_logits": np.zeros(()) for moment in ("first", "second")}
    )


def residual_split(
    rows: list[restatement.Row], gradient: np.ndarray, levels: np.ndarray, stage: int, noise: object
) -> tuple[list[restatement.Row], int]:
    """Who reaches .00067 times 2^((level - stage) / 3), or .00067 at the stage and above, keeps .3 of its opacity and
    gets a child: drawn from it, 1.6 times smaller, as opaque as it was."""
    parents, children = [], []
    for i, row in enumerate(rows):
        threshold = 0.00067 * (2 ** ((levels[i] - stage) / 3) if levels[i] < stage else 1)
        if gradient[i] < threshold:
            parents.append(row)
            continue
        scales = np.exp(row["log_scales"])
        offset = restatement.rotation(row["quaternions"]) @ (scales * next(noise))  # type: ignore[call-overload]
        children.append(restatement.newborn(row, row["means"] + offset, np.log(scales / 1.6)))
        parents.append(with_opacity(row, 0.3 * opacity(row), moments=False))
    return parents + children, len(children)


@pytest.mark.parametrize(("step", "stage"), [(800, 1), (2400, 3), (4100, 5)])
@pytest.mark.parametrize("seed", range(2))
def test_res_gs_round(seed: int, step: int, stage: int) -> None:
    densifier = ResGS(**WINDOW)  # type: ignore[arg-type]
    trainable, _ = prepared(densifier, seed)
    draw = np.random.default_rng(seed)
    gradient, levels = draw.uniform(0, 1e-3, 60), draw.integers(0, 8, 60)
    densifier.statistics["gradient_sum"] = torch.from_numpy(gradient)
    densifier.statistics["visible_count"][:] = 1
    densifier.statistics["level"] = torch.from_numpy(levels.astype(np.int32))
    rows = to_rows(trainable)
    foreseen = densifier.forecast(Refinement(step, trainable, torch.Generator(), event=None))  # type: ignore[arg-type]
    event = densifier.refine(step, trainable, torch.Generator().manual_seed(seed))
    noise = torch.randn(event.split_gradient, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    grown, count = residual_split(rows, gradient, levels, stage, iter(noise.numpy()))
    assert event.split_gradient == count > 0
    kept = [row for row in grown if opacity(row) >= 0.005]
    assert_same(trainable, kept)
    assert (event.pruned_opacity, event.pruned_size, event.cloned) == (len(grown) - len(kept), 0, 0)
    assert event.balances()
    assert event.after == foreseen
    below = [0.00067 * (2 ** ((level - stage) / 3) if level < stage else 1) for level in levels]
    children = [level + 1 for level, value, least in zip(levels, gradient, below, strict=True) if value >= least]
    everybody = [*levels, *children]
    expected = [level for level, row in zip(everybody, grown, strict=True) if opacity(row) >= 0.005]
    assert densifier.statistics["level"].tolist() == expected  # and a round does not forget them
    assert not densifier.statistics["gradient_sum"].any()


def test_the_stages_are_those_of_the_authors_loop() -> None:
    """Their counters, one iteration after another: three parts of each phase, changes at 2,500 and 6,000, a pause of
    500 iterations after each."""
    changes, level, warm, last, ahead = [2500, 6000], 1, 0, 700, 2500
    count = (ahead - last) // 3
    stages, paused, reached = {}, {}, 0
    for step in range(1, 12_000):
        stages[step], paused[step] = level, warm != 0
        if step in changes:
            reached += 1
            warm, last = 500, step + 500
            ahead = changes[reached] if reached < 2 else 12_000
            level, count = 3 * reached + 1, (ahead - last) // 3
        if warm:
            warm -= 1
        if count and not warm and 700 < step < 12_000:
            count -= 1
            if count == 0:
                level += 1
                count = (ahead - last) // 3
    densifier = ResGS(**WINDOW)  # type: ignore[arg-type]
    for step in range(800, 12_000, 100):
        assert densifier.warming_up(step) == paused[step], step
        if not paused[step]:
            assert densifier.stage(step) == stages[step], step
    assert {stages[step] for step in range(800, 12_000, 100)} == set(range(1, 10))


def test_from_the_end_of_the_first_phase_on_all_opacities_fade_every_500_iterations() -> None:
    densifier = ResGS(**WINDOW)  # type: ignore[arg-type]
    faded, pruned = [], []
    for step in range(500, 26_000, 500):
        trainable, _ = prepared(densifier, 3)
        densifier.statistics["gradient_sum"].zero_()
        before = trainable.values.opacities.detach().clone()
        event = densifier.refine(step, trainable, torch.Generator())
        if event is None:
            continue
        kept = before[before >= 0.005] if event.pruned_opacity else before
        ratio = trainable.values.opacities.detach() / kept
        assert not event.opacity_reset
        if (ratio < 0.9).any():
            torch.testing.assert_close(ratio, torch.full_like(ratio, 0.8))
            assert not trainable.adam["opacity_logits"].first.any()
            faded.append(step)
            if step >= 12_000:
                pruned.append(event.pruned_opacity)
    assert faded == list(range(2500, 25_000, 500))  # their level has gone up when they ask: 45 times
    assert min(pruned) > 0


def test_gradients_are_gathered_from_500_on_but_not_in_the_pauses() -> None:
    densifier = ResGS(**WINDOW)  # type: ignore[arg-type]
    trainable, _ = prepared(densifier, 0)
    rng = np.random.default_rng(0)
    for step in (500, 2501, 2999, 6001):
        observe(densifier, trainable, rng, step)
        assert not densifier.statistics["visible_count"].any(), step
    for step in (501, 2500, 3000, 6500):
        observe(densifier, trainable, rng, step)
        assert densifier.statistics["visible_count"].any(), step
        densifier.statistics["visible_count"].zero_()


def test_in_a_short_window_there_is_no_pause_and_phases_must_rise() -> None:
    densifier = ResGS(start=200, stop=1000)
    assert [densifier.stage(step) for step in range(300, 1000, 100)] == sorted(
        densifier.stage(step) for step in range(300, 1000, 100)
    )
    assert not any(densifier.warming_up(step) for step in range(1000))
    with pytest.raises(InputError, match=r"densify\.phase_ends must rise"):
        ResGS(phase_ends=[0.5, 0.2])


def test_a_governed_round_ends_at_its_target() -> None:
    densifier = ResGS(max_gaussians=90, cap="governor", start=500, stop=1200)
    trainable, _ = prepared(densifier, 2)
    trainable.values.opacity_logits.data[:] = 1.0
    densifier.statistics["gradient_sum"] = 1e-3 * torch.rand(60, generator=torch.Generator().manual_seed(0))
    densifier.statistics["visible_count"][:] = 1
    event = densifier.refine(1100, trainable, torch.Generator())
    assert event.target == event.after == 90


def test_a_hard_cap_admits_the_largest_gradients() -> None:
    densifier = ResGS(max_gaussians=63, cap="hard", **WINDOW)  # type: ignore[arg-type]
    trainable, _ = prepared(densifier, 2)
    trainable.values.opacity_logits.data[:] = 1.0
    densifier.statistics["gradient_sum"] = torch.arange(60, dtype=torch.float64)
    densifier.statistics["visible_count"][:] = 1
    event = densifier.refine(800, trainable, torch.Generator())
    assert (event.split_gradient, event.after) == (3, 63)
    assert event.blocked_by_cap == 56
