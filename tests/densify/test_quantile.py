"""A rate of growth instead of a threshold, against counting by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsbench.densify import QuantileADC, Refinement
from tests.densify import restatement
from tests.densify.test_rounds import EXTENT, assert_same, noise_of, prepared, to_rows


@pytest.mark.parametrize("step", [600, 3100])
@pytest.mark.parametrize("rate", [0.1, 0.5, 3.0])
def test_quantile_round(rate: float, step: int) -> None:
    """The share with the largest gradients grows as in ADC, nobody that was never seen; then the faintest go."""
    densifier = QuantileADC(growth_rate=rate, prune_share=0.05)
    trainable, _ = prepared(densifier, 4)
    draws = np.random.default_rng(4)
    gradient = draws.uniform(0, 1e-6, 60) * (draws.random(60) < 0.8)
    densifier.statistics["gradient_sum"] = torch.from_numpy(gradient)
    densifier.statistics["visible_count"][:] = 1
    rows, expected = to_rows(trainable), {}
    foreseen = densifier.forecast(Refinement(step, trainable, torch.Generator(), event=None))  # type: ignore[arg-type]
    event = densifier.refine(step, trainable, torch.Generator().manual_seed(4))
    places = min(int(60 * rate), int((gradient > 0).sum()))
    chosen = np.zeros(60)
    chosen[np.argsort(-gradient, kind="stable")[:places]] = 1
    assert event.cloned + event.split_gradient == places
    noise = iter(noise_of(4, [event.split_gradient]))
    rows = restatement.adc_growth(rows, chosen, EXTENT, noise, expected)
    limit = np.quantile([row["opacity_logits"] for row in rows], 0.05)
    faint = [row["opacity_logits"] < limit for row in rows]
    huge = [step > 3000 and np.exp(row["log_scales"]).max() > 0.1 * EXTENT for row in rows]
    assert_same(trainable, [row for row, f, h in zip(rows, faint, huge, strict=True) if not f and not h])
    assert event.pruned_opacity == sum(faint) > 0
    assert event.balances()
    assert event.after == foreseen


def test_the_governor_moves_the_rate() -> None:
    densifier = QuantileADC(max_gaussians=80, cap="governor", start=500, stop=1200, prune_share=0.0)
    trainable, _ = prepared(densifier, 2)
    densifier.statistics["gradient_sum"] += 1e-6
    event = densifier.refine(1100, trainable, torch.Generator())
    assert event.target == event.after == 80
