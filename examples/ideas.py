"""Ideas that are not densifiers: two terms, a schedule, an optimiser (docs/ideas.md)."""

from dataclasses import dataclass

import torch


@dataclass
class LowOpacity:
    """The mean opacity as a term: Gaussians that nothing needs fade, and are pruned."""

    def __call__(self, step):
        return step.gaussians.opacity_logits.sigmoid().mean()


@dataclass
class SmoothDepth:
    """Depth changes little where the photograph does (edge-aware smoothness)."""

    sharpness: float = 10.0
    needs_depth = True

    def __call__(self, step):
        depth, photograph = step.render.depth, step.photograph
        edges = (photograph.diff(dim=1).abs().mean(-1) * -self.sharpness).exp()
        return (edges * depth.diff(dim=1).abs() / depth.detach().mean().clamp_min(1e-6)).mean()


@dataclass
class WarmUp:
    """All learning rates rise from 0 over the first iterations."""

    length: int = 200

    def __call__(self, iteration, rates):
        part = min(1.0, iteration / self.length)
        return {name: part * rate for name, rate in rates.items()}


@dataclass
class SignMomentum:
    """The sign of the momentum (as in Lion, arXiv 2302.06675) for opacities; Adam for the rest."""

    beta: float = 0.9
    groups = ("opacity_logits",)

    def init(self, parameter):
        return {"momentum": torch.zeros_like(parameter)}

    def step(self, parameter, gradient, state, rate, count):
        state["momentum"].lerp_(gradient, 1 - self.beta)
        parameter -= rate * state["momentum"].sign()
