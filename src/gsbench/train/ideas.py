"""Parts of a training that a user's class may replace: loss, terms, schedule and optimiser.

``train.loss``, ``train.schedule`` and ``train.optimizer`` name a class each, ``train.terms`` any
number of classes (docs/ideas.md). All of them are dataclasses whose fields are their options. A
class with a state has ``state_dict()`` and ``load_state_dict(state)``: checkpoints keep it.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import torch
from torch import Tensor

from gsbench.errors import TrainingError
from gsbench.gaussians.model import Gaussians
from gsbench.gaussians.trainable import Optimizer
from gsbench.raster.base import RenderOutput
from gsbench.scene.types import Camera
from gsbench.words import NamesAttributes, raised


@dataclass(frozen=True)
class TrainedView(NamesAttributes):
    """The training view of an iteration.

    ``photograph`` is [H, W, 3] in 0..1. ``mask`` is [H, W, 1], True where a pixel counts; None if
    all do. ``depth`` is a sensor's depth along the camera's z, [H, W] in the training's units, 0
    where it is not known; None without one. ``more`` are other pictures beside the photograph,
    [H, W, C] uint8 by name. ``scene.beside`` asks for both.
    """

    name: str
    camera: Camera
    photograph: Tensor
    mask: Tensor | None = None
    depth: Tensor | None = None
    more: Mapping[str, Tensor] = field(default_factory=dict)


@dataclass(frozen=True)
class Step(NamesAttributes):
    """Facts that a loss or a term may read of an iteration (1, 2, …).

    ``render`` has ``image`` [H, W, 3], ``alpha`` [H, W] and, if the class asks for it
    (``needs_depth = True``), ``depth`` [H, W]; masked pixels of the image are those of the
    photograph. Everything of ``render`` and ``gaussians`` has gradients. ``rng`` is the training's
    generator for its parts, on the CPU; checkpoints keep its state.
    """

    iteration: int
    render: RenderOutput
    view: TrainedView
    gaussians: Gaussians
    rng: torch.Generator

    @property
    def photograph(self) -> Tensor:
        return self.view.photograph

    @property
    def mask(self) -> Tensor | None:
        return self.view.mask

    @property
    def camera(self) -> Camera:
        return self.view.camera


class Term(Protocol):
    """A loss, or a term that is added to it: a scalar with a gradient.

    A term with parameters of its own has ``optimize()``, which is called after each backward pass.
    """

    def __call__(self, step: Step) -> Tensor: ...


class Schedule(Protocol):
    """The learning rate of each group of parameters at an iteration (1, 2, …).

    ``rates`` are those of 3DGS at this iteration, by the names of `Gaussians`. The result may have
    some of them; the others stay.
    """

    def __call__(self, iteration: int, rates: Mapping[str, float]) -> Mapping[str, float]: ...


@dataclass(frozen=True)
class WeightedTerm:
    """A term with its weight in the sum; ``label`` names it in metrics and errors."""

    term: Term
    weight: float
    label: str


def weighted(terms: Sequence[tuple[Term, float]]) -> tuple[WeightedTerm, ...]:
    """The ``terms``, labelled by the names of their classes, which are numbered if they repeat."""
    counts: Counter[str] = Counter()
    found = []
    for term, weight in terms:
        name = type(term).__name__
        counts[name] += 1
        label = name if counts[name] == 1 else f"{name}_{counts[name]}"
        found.append(WeightedTerm(term, weight, label))
    return tuple(found)


@dataclass(frozen=True)
class Ideas:
    """The parts that a user's classes replace; by default none."""

    loss: Term | None = None
    terms: tuple[WeightedTerm, ...] = ()
    schedule: Schedule | None = None
    optimizer: Optimizer | None = None

    @property
    def named(self) -> dict[str, Any]:
        """The user's objects by a name of their own, for checkpoints."""
        named = {name: getattr(self, name) for name in ("loss", "schedule", "optimizer")}
        named |= {f"term {one.label}": one.term for one in self.terms}
        return {name: part for name, part in named.items() if part is not None}

    @property
    def reads_renders(self) -> bool:
        """Return whether a part needs the render as a graph of autograd."""
        return self.loss is not None or bool(self.terms)

    def state_dict(self) -> dict[str, Any]:
        return {
            name: part.state_dict()
            for name, part in self.named.items()
            if hasattr(part, "state_dict")
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        for name, own in state.items():
            self.named[name].load_state_dict(own)

    def optimize(self) -> None:
        """Let the parts with parameters of their own step."""
        for part in self.named.values():
            if hasattr(part, "optimize"):
                part.optimize()


NO_IDEAS = Ideas()


def value_of(part: Term, step: Step, label: str) -> Tensor:
    """The value of a loss or a term; raises TrainingError if it is no scalar with a gradient.

    A constant 0 is allowed: a term may begin later.
    """
    try:
        value = part(step)
    except Exception as error:  # it may raise anything
        raise TrainingError(
            f"iteration {step.iteration}: {label} raised {raised(error)}; render.depth needs "
            "needs_depth = True on the class, view.depth needs scene.beside=[depth]"
        ) from error
    if not isinstance(value, Tensor) or value.dim() != 0:
        shape = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
        raise TrainingError(
            f"iteration {step.iteration}: {label} must return a tensor with one number, shape (), "
            f"got {shape}: take its mean or sum"
        )
    if not value.requires_grad and float(value) != 0:
        if not math.isfinite(float(value)):
            raise TrainingError(f"iteration {step.iteration}: {label} became {float(value)}")
        raise TrainingError(
            f"iteration {step.iteration}: {label} returned a number without a gradient: compute it "
            "from step.render or step.gaussians, without detach() or item()"
        )
    return value


def scheduled(schedule: Schedule, iteration: int, rates: Mapping[str, float]) -> dict[str, float]:
    """The rates of a user's schedule; raises TrainingError for an unknown name or a bad number."""
    found = schedule(iteration, dict(rates))
    for name, rate in found.items():
        if name not in rates:
            raise TrainingError(
                f"iteration {iteration}: train.schedule gives a rate for {name!r}; there are: "
                f"{', '.join(rates)}"
            )
        if not math.isfinite(rate) or rate < 0:
            raise TrainingError(
                f"iteration {iteration}: train.schedule gives {name} the rate {rate}: it must be 0 "
                "or above, and finite"
            )
    return {**rates, **found}
