"""AbsGS against a restatement, one Gaussian at a time."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsbench.densify import AbsGS, Refinement
from tests.densify import restatement
from tests.densify.test_rounds import EXTENT, assert_same, noise_of, prepared, to_rows


def growth(
    rows: list[restatement.Row], signed: np.ndarray, absolute: np.ndarray, noise: object
) -> tuple[list[restatement.Row], int, int]:
    """Small (largest scale at most .001 of the extent): a copy where signed >= .0002; large: split where absolute >=
    .0004, into two of 1 / 1.6."""
    largest = [np.exp(row["log_scales"]).max() for row in rows]
    clones = [i for i, size in enumerate(largest) if size <= 0.001 * EXTENT and signed[i] >= 0.0002]
    chosen = [i for i, size in enumerate(largest) if size > 0.001 * EXTENT and absolute[i] >= 0.0004]
    copies = [restatement.newborn(rows[i], rows[i]["means"].copy(), rows[i]["log_scales"].copy()) for i in clones]
    scales = {i: np.log(np.exp(rows[i]["log_scales"]) / 1.6) for i in chosen}
    return restatement.split_all(rows + copies, chosen, scales, noise), len(clones), len(chosen)  # type: ignore[arg-type]


@pytest.mark.parametrize("step", [600, 3100])
@pytest.mark.parametrize("seed", range(3))
def test_absgs_round(seed: int, step: int) -> None:
    densifier = AbsGS()
    trainable, _ = prepared(densifier, seed)
    trainable.values.log_scales.data[::4] -= 4.0  # a quarter below the size of a split
    draw = np.random.default_rng(seed)
    signed, absolute = draw.uniform(0, 4e-4, 60), draw.uniform(0, 8e-4, 60)
    densifier.statistics["gradient_sum"] = torch.from_numpy(signed)
    densifier.statistics["absolute_sum"] = torch.from_numpy(absolute)
    densifier.statistics["visible_count"][:] = 1
    rows, expected = to_rows(trainable), {}
    foreseen = densifier.forecast(Refinement(step, trainable, torch.Generator(), event=None))  # type: ignore[arg-type]
    event = densifier.refine(step, trainable, torch.Generator().manual_seed(seed))
    noise = iter(noise_of(seed, [event.split_gradient]))
    rows, cloned, split = growth(rows, signed, absolute, noise)
    assert (event.cloned, event.split_gradient) == (cloned, split)
    assert min(cloned, split) > 0
    assert_same(trainable, restatement.prune(rows, step, EXTENT, expected))
    assert expected == {name: getattr(event, name) for name in expected}
    assert event.balances()
    assert event.after == foreseen


def test_both_gradients_are_gathered() -> None:
    densifier = AbsGS()
    _, mean = prepared(densifier, 0)  # shows it the same for both
    np.testing.assert_allclose(densifier.mean_gradient(), mean, rtol=1e-6)
    np.testing.assert_allclose(densifier.mean_absolute_gradient(), mean, rtol=1e-6)
    assert densifier.needs_absolute_gradient


def test_every_500_iterations_opacities_are_lowered_to_the_ceiling() -> None:
    densifier = AbsGS()
    trainable, _ = prepared(densifier, 1)
    before = trainable.values.opacities.detach().clone()
    event = densifier.refine(500, trainable, torch.Generator())  # no round yet
    assert (before > 0.8).any()
    torch.testing.assert_close(trainable.values.opacities.detach(), before.clamp_max(0.8))
    assert not trainable.adam["opacity_logits"].first.any()
    assert not event.opacity_reset
    assert densifier.refine(15_000, trainable, torch.Generator()) is None
    densifier.refine(3000, trainable, torch.Generator())
    assert float(trainable.values.opacities.detach().max()) == pytest.approx(0.01)


def test_a_hard_cap_takes_those_farthest_above_their_own_threshold() -> None:
    densifier = AbsGS(max_gaussians=62, cap="hard", prune_opacity=0.0)
    trainable, _ = prepared(densifier, 1)
    trainable.values.log_scales.data[:30] = -9.0
    signed, absolute = torch.full((60,), 3e-4), torch.full((60,), 5e-4)  # 1.5 and 1.25 times theirs
    signed[7], absolute[50] = 9e-4, 2e-3
    densifier.statistics |= {"gradient_sum": signed, "absolute_sum": absolute}
    densifier.statistics["visible_count"][:] = 1
    event = densifier.refine(600, trainable, torch.Generator())
    assert (event.cloned, event.split_gradient) == (1, 1)
