"""The long-axis split against a restatement, one Gaussian at a time."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsbench.densify import LongAxis, Refinement
from tests.densify import restatement
from tests.densify.test_rounds import EXTENT, assert_same, prepared, to_rows


def halves(rows: list[restatement.Row], mean_gradient: np.ndarray) -> list[restatement.Row]:
    """d = 0.45: centres at 3 d s along the longest axis; that axis times 0.55, the others times sqrt(1 - 0.2025)."""
    chosen = [i for i in range(len(rows)) if mean_gradient[i] >= 0.0008]
    children = []
    for side in (1, -1):
        for i in chosen:
            scales = np.exp(rows[i]["log_scales"])
            longest = int(np.argmax(scales))
            axis = restatement.rotation(rows[i]["quaternions"]) @ np.eye(3)[longest]
            new = scales * 0.7975**0.5
            new[longest] = 0.55 * scales[longest]
            child = restatement.newborn(rows[i], rows[i]["means"] + side * 1.35 * scales[longest] * axis, np.log(new))
            opacity = 0.6 / (1 + np.exp(-rows[i]["opacity_logits"]))
            child["opacity_logits"] = np.log(opacity / (1 - opacity))
            children.append(child)
    return [row for i, row in enumerate(rows) if i not in chosen] + children


@pytest.mark.parametrize("step", [600, 3100])
@pytest.mark.parametrize("seed", range(3))
def test_long_axis_round(seed: int, step: int) -> None:
    densifier = LongAxis(gradient="absolute", gradient_threshold=0.0008)
    trainable, _ = prepared(densifier, seed)
    gradient = np.random.default_rng(seed).uniform(0, 0.0016, len(trainable))
    densifier.statistics["gradient_sum"] = torch.from_numpy(gradient)
    densifier.statistics["visible_count"][:] = 1
    rows, expected = to_rows(trainable), {}
    foreseen = densifier.forecast(Refinement(step, trainable, torch.Generator(), event=None))  # type: ignore[arg-type]
    event = densifier.refine(step, trainable, torch.Generator())
    grown = halves(rows, gradient)
    assert event.split_gradient == len(grown) - len(rows) > 0
    assert event.cloned == 0
    assert_same(trainable, restatement.prune(grown, step, EXTENT, expected))
    assert expected == {name: getattr(event, name) for name in expected}
    assert event.balances()
    assert event.after == foreseen


def test_a_hard_cap_holds() -> None:
    densifier = LongAxis(max_gaussians=70, cap="hard", gradient_threshold=1e-6)
    trainable, _ = prepared(densifier, 1)
    event = densifier.refine(600, trainable, torch.Generator())
    assert event.before + event.split_gradient == 70
    assert event.blocked_by_cap > 0
    assert event.balances()
