"""Improved-GS: halves along the longest axis, of candidates that are drawn by the edges that they cover."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from pydantic import PositiveInt
from torch import Tensor

from gsbench.densify.base import Refinement
from gsbench.densify.budget import allowance
from gsbench.densify.long_axis import LongAxis
from gsbench.densify.scores import blended_sums, by_median, draw, draw_views, edge_map
from gsbench.gaussians.model import Gaussians

RAMP_ROUNDS = 5  # before the end of the window the budget of cap=root is reached: 500 iterations in the authors' code


@dataclass
class EdgeAware(LongAxis):
    """The long-axis split of candidates drawn by the edge-aware score of Deng et al. (arXiv 2508.12313).

    Of ``score_views`` training views, drawn in each round, the score of a Gaussian is the mean of sum over pixels of
    (edge strength of the photograph) alpha T, each view's over its median. Who is over the gradient threshold is drawn
    without replacement in proportion to it, as many as the budget admits. ``cap=root`` is their growth control:
    ``max_gaussians`` sqrt(x), x the progress of the window up to five rounds before its end.
    """

    score_views: PositiveInt = 10
    cap: Literal["root", "curve", "hard"] = "root"  # type: ignore[assignment]
    max_gaussians: PositiveInt = 1_000_000

    def allowance(self, refinement: Refinement) -> int | None:
        if self.cap != "root":
            return super().allowance(refinement)
        ramp = max(self.stop - RAMP_ROUNDS * self.interval - self.start, self.interval)
        progress = min((refinement.step - self.start) / ramp, 1.0)
        return allowance(len(refinement.gaussians), round(self.max_gaussians * math.sqrt(progress)), "hard")

    def choose(self, refinement: Refinement, candidates: Tensor, gain: int) -> tuple[Tensor, int]:
        count, allowed = int(candidates.sum()), self.allowance(refinement)
        assert allowed is not None  # no cap of this class is without a limit
        if count <= allowed or allowed == 0:
            return candidates & (allowed > 0), max(0, count - allowed)
        scores = self.edge_scores(refinement.gaussians.values, refinement.step, refinement.rng)
        return draw(candidates, scores, allowed, refinement.rng), count - allowed

    def edge_scores(self, gaussians: Gaussians, step: int, rng: torch.Generator) -> Tensor:
        """The edge-aware score, [N]."""
        views, total = self.context.training_views, torch.zeros_like(gaussians.opacity_logits)
        chosen = draw_views(views, self.score_views, rng)
        for index in chosen:
            edges = edge_map(views.image(index)).to(total.dtype).unsqueeze(-1)  # [H, W, 1]
            sums, _ = blended_sums(views, index, gaussians, step, edges.expand(-1, -1, 3).contiguous())
            total += by_median(sums[:, 0])
        return total / len(chosen)
