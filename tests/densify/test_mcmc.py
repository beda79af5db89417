"""A round of MCMC and its noise against a restatement, one Gaussian at a time."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from gsbench.densify import MCMC, DensifyContext
from gsbench.gaussians.paper_values import LearningRates
from gsbench.gaussians.trainable import TrainableGaussians
from tests.densify import restatement
from tests.densify.test_rounds import assert_same, to_rows
from tests.gaussians.helpers import random_gaussians


def opacity(row: restatement.Row) -> float:
    return 1 / (1 + np.exp(-row["opacity_logits"]))


def drawn(rows: list[restatement.Row], weights: list[float], count: int, rng: torch.Generator) -> list[int]:
    """With replacement: where uniform numbers fall on the line of all weights."""
    line = np.cumsum(weights)
    numbers = torch.rand(count, generator=rng, dtype=torch.float64).numpy() * line[-1]
    return [next(i for i in range(len(rows)) if line[i] > number) for number in numbers]


def shared(row: restatement.Row, copies: int) -> restatement.Row:
    """eq. 9: opacity and scale of each of so many, and moments that begin anew."""
    o, n = opacity(row), min(copies, 50)
    new = 1 - (1 - o) ** (1 / n)
    total = sum(
        math.comb(i - 1, k) * (-1) ** k * new ** (k + 1) / math.sqrt(k + 1) for i in range(1, n + 1) for k in range(i)
    )
    kept = max(0.005, min(new, 1 - 1e-6))
    changed = restatement.newborn(row, row["means"].copy(), row["log_scales"] + math.log(o / total))
    return changed | {"opacity_logits": np.log(kept / (1 - kept))}


def with_copies(rows: list[restatement.Row], sources: list[int]) -> list[restatement.Row]:
    counts = {i: sources.count(i) + 1 for i in set(sources)}
    sharing = [shared(row, counts[i]) if i in counts else row for i, row in enumerate(rows)]
    return sharing + [{name: np.array(value) for name, value in sharing[i].items()} for i in sources]


def prepared(count: int, seed: int, **options: Any) -> tuple[MCMC, TrainableGaussians]:
    gaussians = random_gaussians(count, seed)
    gaussians.opacity_logits[: count // 4] = -9.0
    densifier, trainable = MCMC(**options), TrainableGaussians(gaussians, LearningRates(), 4.0)
    for tensor in trainable.values.tensors().values():
        tensor.grad = torch.full_like(tensor, 1e-3)
    trainable.optimizer_step()
    densifier.begin(trainable.values.detach(), DensifyContext(4.0))
    return densifier, trainable


@pytest.mark.parametrize("growth", [0.05, 0.5])
@pytest.mark.parametrize("seed", range(3))
def test_mcmc_round(seed: int, growth: float) -> None:
    densifier, trainable = prepared(40, seed, max_gaussians=55, growth=growth)
    rows = to_rows(trainable)
    event = densifier.refine(600, trainable, torch.Generator().manual_seed(seed))
    rng = torch.Generator().manual_seed(seed)
    dead = [opacity(row) <= 0.005 for row in rows]
    weights = [0.0 if gone else opacity(row) for row, gone in zip(rows, dead, strict=True)]
    sources = drawn(rows, weights, sum(dead), rng)
    place = np.cumsum([not gone for gone in dead]) - 1  # of the living, when the dead have gone
    alive = [row for row, gone in zip(rows, dead, strict=True) if not gone]
    rows = with_copies(alive, [int(place[i]) for i in sources])
    more = min(int((1 + growth) * 40), 55) - 40
    rows = with_copies(rows, drawn(rows, [opacity(row) for row in rows], more, rng))
    assert_same(trainable, rows)
    assert (event.relocated, event.added) == (10, more)


def test_mcmc_noise() -> None:
    """R S S R^T times a normal draw, times sigmoid(-100 (o - .005)), times 5e5 and the rate of the means."""
    densifier, trainable = prepared(40, 1)
    trainable.values.opacity_logits.data.copy_(torch.linspace(-9, 2, 40))
    trainable.set_step(1)
    rows = to_rows(trainable)
    densifier.after_step(1, trainable, torch.Generator().manual_seed(0))
    noise = torch.randn(40, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64).numpy()
    for i, row in enumerate(rows):
        axes = restatement.rotation(row["quaternions"]) * np.exp(row["log_scales"])
        gate = 1 / (1 + np.exp(100 * (opacity(row) - 0.005)))
        row["means"] = row["means"] + axes @ axes.T @ noise[i] * gate * 5e5 * trainable.position_rate
    assert_same(trainable, rows)
