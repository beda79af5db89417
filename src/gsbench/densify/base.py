"""The contract of a densifier: hyper-parameters, a state that can be saved, and a record of what each refinement
did."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gsbench.densify.events import Cause, Lineage, RefineEvent
from gsbench.gaussians.model import Gaussians
from gsbench.gaussians.trainable import TrainableGaussians
from gsbench.raster.base import RenderOutput
from gsbench.settings import check_settings


@dataclass(frozen=True)
class DensifyContext:
    """What a densifier knows of the training that it serves."""

    extent: float  # world units: 3DGS's cameras_extent
    white_background: bool = False


class Densifier:
    """Base of all densifiers, and the one that never changes the Gaussians (``densify=none``).

    A subclass is a dataclass of hyper-parameters, whose annotations say what is allowed. In every iteration the trainer
    calls ``regularizer`` before the backward pass, ``observe`` after it, then ``refine``, then the optimiser step, then
    ``after_step``. Mutable state is in ``context``, ``lineage`` and what ``state_dict`` of a subclass adds.
    """

    context: DensifyContext
    lineage: Lineage
    needs_absolute_gradient: bool = False

    def __post_init__(self) -> None:
        """Check the hyper-parameters against their annotations; a subclass adds the rules between them."""
        check_settings(self, "densify")

    def prepare(self, gaussians: Gaussians) -> Gaussians:
        """The Gaussians that the training starts with, from those of the initial cloud."""
        return gaussians

    def begin(self, gaussians: Gaussians, context: DensifyContext) -> None:
        """Start a training of ``gaussians``: forget all earlier state."""
        self.context = context
        self.lineage = Lineage(len(gaussians))

    def regularizer(self, gaussians: Gaussians) -> Tensor | None:
        """A term added to the loss, or None."""
        return None

    def observe(self, step: int, render: RenderOutput) -> None:
        """Gather statistics of iteration ``step`` (1, 2, …) after its backward pass."""

    def refine(self, step: int, gaussians: TrainableGaussians, rng: torch.Generator) -> RefineEvent | None:
        """Change the Gaussians if ``step`` is due, and say what was done; None where nothing was due."""
        return None

    def after_step(self, step: int, gaussians: TrainableGaussians, rng: torch.Generator) -> None:
        """Called after the optimiser step of iteration ``step``."""

    def state_dict(self) -> dict[str, Any]:
        """The state as tensors and plain values; with the same hyper-parameters, ``load_state_dict`` goes on from
        it."""
        return {"lineage": self.lineage.state_dict()}

    def load_state_dict(self, state: dict[str, Any], context: DensifyContext) -> None:
        self.context = context
        self.lineage = Lineage.from_state(state["lineage"])

    def _edit(
        self,
        gaussians: TrainableGaussians,
        step: int,
        keep: Tensor | None = None,
        append: Gaussians | None = None,
        parents: Tensor | None = None,
        cause: Cause = Cause.INITIAL,
    ) -> None:
        """Edit Gaussians, lineage and statistics together; ``parents`` [A] are the indices, before the edit, of those
        appended."""
        gaussians.edit(keep, append)
        self.lineage.edit(keep, parents, cause, step)
        self._carry_statistics(keep, 0 if append is None else len(append))

    def _carry_statistics(self, keep: Tensor | None, added: int) -> None:
        """Follow an edit with what was gathered: that of the Gaussians at the mask ``keep`` [N], then ``added`` new."""


class NoDensifier(Densifier):
    """``densify=none``: the initial Gaussians are only optimised."""
