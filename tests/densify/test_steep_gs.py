"""SteepGS against a restatement, one Gaussian at a time."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import torch

from gsbench.densify import Refinement, SteepGS
from gsbench.raster.base import RenderOutput
from tests.densify import restatement
from tests.densify.test_rounds import EXTENT, assert_same, noise_of, prepared, to_rows


def least(matrix: np.ndarray) -> tuple[float, np.ndarray]:
    values, vectors = np.linalg.eigh(matrix)
    vector = vectors[:, 0]
    return float(values[0]), vector * np.sign(vector[np.abs(vector).argmax()])


def growth(
    rows: list[restatement.Row],
    gradient: np.ndarray,
    matrices: np.ndarray,
    noise: Iterator[np.ndarray],
    rate: float,
    threshold: float = -1e-6,
    opacity: float = 0.5,
) -> tuple[list[restatement.Row], int]:
    """Two halves on either side along the least eigenvector for each that reaches .0002 and has an eigenvalue below.

    Large: scales / 1.6, at the length of a draw each; small: as large as before, a step of the means away.
    """
    chosen = [
        i for i in range(len(rows)) if gradient[i] >= 0.0002 and least(matrices[i])[0] * EXTENT * EXTENT < threshold
    ]
    children = []
    for side in (1, -1):
        for i in chosen:
            scales, draw = np.exp(rows[i]["log_scales"]), next(noise)
            large = scales.max() > 0.01 * EXTENT
            length = np.sqrt(((draw * scales) ** 2).sum()) if large else rate
            new = np.log(scales / 1.6) if large else rows[i]["log_scales"].copy()
            child = restatement.newborn(rows[i], rows[i]["means"] + side * length * least(matrices[i])[1], new)
            share = opacity / (1 + np.exp(-rows[i]["opacity_logits"]))
            child["opacity_logits"] = np.log(share / (1 - share))
            children.append(child)
    return [row for i, row in enumerate(rows) if i not in chosen] + children, len(chosen)


def given(densifier: SteepGS, seed: int, count: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """Statistics of three visible iterations: mean gradients [N] and symmetric matrices [N, 3, 3], per iteration."""
    draw = np.random.default_rng(seed)
    gradient = draw.uniform(0, 4e-4, count)
    matrices = draw.normal(0, 1e-5, (count, 3, 3)) + 1e-5 * np.eye(3)
    matrices += matrices.transpose(0, 2, 1)
    densifier.statistics["gradient_sum"] = torch.from_numpy(3 * gradient)
    densifier.statistics["splitting_sum"] = torch.from_numpy(3 * matrices)
    densifier.statistics["visible_count"][:] = 3
    return gradient, matrices


@pytest.mark.parametrize("step", [600, 3100])
@pytest.mark.parametrize("seed", range(3))
def test_steep_gs_round(seed: int, step: int) -> None:
    densifier = SteepGS()
    trainable, _ = prepared(densifier, seed)
    trainable.values.log_scales.data[::4] -= 3.0  # small ones, too
    trainable.set_step(step)
    gradient, matrices = given(densifier, seed)
    rows, expected = to_rows(trainable), {}
    foreseen = densifier.forecast(Refinement(step, trainable, torch.Generator(), event=None))  # type: ignore[arg-type]
    rate = trainable.position_rate
    event = densifier.refine(step, trainable, torch.Generator().manual_seed(seed))
    noise = iter(noise_of(seed, [event.split_gradient]))
    rows, chosen = growth(rows, gradient, matrices, noise, rate)
    assert 0 < chosen < (gradient >= 0.0002).sum()
    assert event.split_gradient == chosen
    assert_same(trainable, restatement.prune(rows, step, EXTENT, expected))
    assert expected == {name: getattr(event, name) for name in expected}
    assert event.balances()
    assert event.after == foreseen
    assert not densifier.statistics["splitting_sum"].any()
    assert densifier.statistics["splitting_sum"].shape == (len(trainable), 3, 3)


def test_the_eigenvalue_is_one_of_the_mean_matrix_in_units_of_the_squared_extent() -> None:
    densifier = SteepGS()
    prepared(densifier, 0)
    densifier.statistics["visible_count"][:] = 2
    densifier.statistics["splitting_sum"][:] = torch.diag(torch.tensor([4e-8, -6e-8, 2e-8]))
    values, directions = densifier.steepest(torch.tensor([0, 1]))
    assert values.tolist() == pytest.approx([-3e-8 * EXTENT**2] * 2)
    assert directions.tolist() == [[0.0, 1.0, 0.0]] * 2


def test_each_ingredient_can_be_taken_out() -> None:
    densifier = SteepGS(eigenvalue_threshold=None, opacity_factor=1.0)
    trainable, _ = prepared(densifier, 1)
    gradient, matrices = given(densifier, 1)
    rows, rate = to_rows(trainable), trainable.position_rate
    event = densifier.refine(600, trainable, torch.Generator().manual_seed(1))
    assert event.split_gradient == (gradient >= 0.0002).sum()
    noise = iter(noise_of(1, [event.split_gradient]))
    rows, _ = growth(rows, gradient, matrices, noise, rate, threshold=np.inf, opacity=1.0)
    assert_same(trainable, restatement.prune(rows, 600, EXTENT, {}))


def test_under_a_hard_cap_those_come_first_whom_a_split_helps_most() -> None:
    densifier = SteepGS(max_gaussians=63, cap="hard", prune_opacity=0.0)
    trainable, _ = prepared(densifier, 2)
    gradient, matrices = given(densifier, 2)
    order = [i for i in np.argsort([least(m)[0] for m in matrices]) if gradient[i] >= 0.0002]
    before = trainable.values.sh_dc.detach().clone()
    event = densifier.refine(600, trainable, torch.Generator())
    assert (event.split_gradient, event.after) == (3, 63)
    assert event.blocked_by_cap > 0
    kept = {tuple(row) for row in trainable.values.sh_dc.detach()[:57].tolist()}
    gone = {i for i in range(60) if tuple(before[i].tolist()) not in kept}
    assert gone == set(order[:3])


def test_a_round_solves_for_the_eigenvectors_once(monkeypatch: pytest.MonkeyPatch) -> None:
    densifier = SteepGS()
    trainable, _ = prepared(densifier, 1)
    gradient, _ = given(densifier, 1)
    solve, sizes = torch.linalg.eigh, []

    def counting(matrices: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        sizes.append(len(matrices))
        return solve(matrices)

    monkeypatch.setattr(torch.linalg, "eigh", counting)
    densifier.refine(600, trainable, torch.Generator())
    assert sizes == [(gradient >= 0.0002).sum()]


def test_the_matrices_of_visible_iterations_add_up() -> None:
    densifier = SteepGS()
    trainable, _ = prepared(densifier, 0)
    count = len(trainable)
    before = densifier.statistics["splitting_sum"].clone()
    probe = torch.zeros(count, 3, 3, requires_grad=True)
    probe.grad = torch.arange(9.0).reshape(3, 3).expand(count, 3, 3)
    points = torch.zeros(count, 2, dtype=torch.float64, requires_grad=True)
    points.grad = torch.zeros(count, 2, dtype=torch.float64)
    radii = torch.ones(count, dtype=torch.int32)
    render = RenderOutput(torch.empty(0), torch.empty(0), radii, points, splitting_probe=probe)
    densifier.observe(7, render)
    densifier.observe(8, render)
    torch.testing.assert_close(densifier.statistics["splitting_sum"] - before, 2 * probe.grad)
    densifier.observe(densifier.stop, render)
    torch.testing.assert_close(densifier.statistics["splitting_sum"] - before, 2 * probe.grad)
    render.splitting_probe = None
    with pytest.raises(RuntimeError, match="splitting_matrix=True"):
        densifier.observe(9, render)
