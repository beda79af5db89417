"""The contract of a densifier: hyper-parameters, a state that can be saved, the origin of every Gaussian, and a record
of what each refinement did."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from gsbench.densify.operations import revised_logits, split
from gsbench.densify.scores import TrainingViews
from gsbench.events import Cause, RefineEvent
from gsbench.gaussians.model import Gaussians
from gsbench.gaussians.trainable import TrainableGaussians
from gsbench.raster.base import RenderOutput
from gsbench.settings import Switch, check_settings


class Lineage:
    """An identity, a parent and a cause for every Gaussian that ever existed in a training; always on the CPU.

    ``ids`` [N] names the Gaussians that live now; ``parents``, ``causes`` and ``steps`` [T] hold the history of all T.
    """

    def __init__(self, num_gaussians: int) -> None:
        self.ids = torch.arange(num_gaussians)  # [N]
        self.initial_count = num_gaussians
        self._parents = [torch.full((num_gaussians,), -1, dtype=torch.int64)]
        self._causes = [torch.full((num_gaussians,), int(Cause.INITIAL), dtype=torch.uint8)]
        self._steps = [torch.zeros(num_gaussians, dtype=torch.int32)]
        self._total = num_gaussians

    def edit(self, keep: Tensor | None, parents: Tensor | None, cause: Cause, step: int) -> None:
        """Keep the living at the mask ``keep`` [N], then append children of ``parents`` [A] (indices before that)."""
        living = self.ids if keep is None else self.ids[keep.cpu()]
        if parents is not None and len(parents):
            a = len(parents)
            self._parents.append(self.ids[parents.cpu()])
            self._causes.append(torch.full((a,), int(cause), dtype=torch.uint8))
            self._steps.append(torch.full((a,), step, dtype=torch.int32))
            living = torch.cat([living, torch.arange(self._total, self._total + a)])
            self._total += a
        self.ids = living

    def causes_of_living(self) -> dict[str, int]:
        """Count the living Gaussians of each cause."""
        counts = torch.bincount(torch.cat(self._causes)[self.ids].long(), minlength=len(Cause))
        return {cause.key: int(counts[cause]) for cause in Cause}

    def state_dict(self) -> dict[str, Tensor]:
        """``ids``, ``parents``, ``causes`` and ``steps`` as tensors; also what ``lineage.npz`` of a trial holds."""
        return {
            "ids": self.ids.clone(),
            "parents": torch.cat(self._parents),
            "causes": torch.cat(self._causes),
            "steps": torch.cat(self._steps),
        }

    @classmethod
    def from_state(cls, state: dict[str, Tensor]) -> Lineage:
        lineage = cls(0)
        parents = state["parents"].cpu()
        lineage.ids = state["ids"].cpu().clone()
        lineage._parents, lineage._causes, lineage._steps = [parents], [state["causes"].cpu()], [state["steps"].cpu()]
        lineage._total = len(parents)
        lineage.initial_count = int((parents < 0).sum())
        return lineage


CPU = torch.device("cpu")
NEVER = 10**9  # an iteration, or an interval, beyond any training


@dataclass(frozen=True)
class DensifyContext:
    """Facts of a training that its densifier is given."""

    extent: float  # world units: 3DGS's cameras_extent
    white_background: bool = False
    device: torch.device = CPU  # of the Gaussians
    views: TrainingViews | None = None
    # A count that the training wants a round to stay below, for the most that there may ever be (None: not said).
    limit: Callable[[Refinement, int | None], int] | None = None

    @property
    def training_views(self) -> TrainingViews:
        """``views``, which a trainer gives."""
        if self.views is None:
            raise RuntimeError("this densifier looks at training views: give them as DensifyContext.views")
        return self.views


@dataclass
class Refinement:
    """One refinement under way: what its rules read, change and count."""

    step: int
    gaussians: TrainableGaussians
    rng: torch.Generator
    event: RefineEvent


Rule = Callable[[Refinement], None]


class Statistic(NamedTuple):
    """A statistic of more than one number for each Gaussian: ``Statistic(torch.float32, (3, 3))`` is [N, 3, 3]."""

    dtype: torch.dtype
    shape: tuple[int, ...] = ()


class Densifier:
    """Base of all densifiers, and the one that never changes the Gaussians (``densify=none``).

    A subclass is a dataclass of hyper-parameters, whose annotations say what is allowed. In every iteration the trainer
    calls ``regularizer`` before the backward pass, ``observe`` after it, then ``refine``, then the optimiser step, then
    ``after_step``. A subclass says what happens by ``rules``, and what it gathers by ``STATISTICS``, besides those of
    its own base; and which of its parts can be taken out by ``SWITCHES``, for ``gsbench ablate``.

    State: ``context``; ``lineage``; and ``statistics``, one tensor [N] for each name in ``STATISTICS``, or [N, …] for a
    `Statistic` with a shape, zero at the start. They follow every ``edit`` (the new have zero), are saved, and are on
    the device of the Gaussians.

    Examples:
        A rule that clones, every ``interval`` iterations, what is nearly opaque:

        >>> @dataclass
        ... class CloneOpaque(Densifier):
        ...     interval: int = 100
        ...     opacity: float = 0.9
        ...
        ...     def rules(self, refinement):
        ...         return [self.grow] if refinement.step % self.interval == 0 else []
        ...
        ...     def grow(self, refinement):
        ...         opaque = refinement.gaussians.values.opacity_logits.sigmoid() > self.opacity  # [N]
        ...         refinement.event.cloned += self.clone(refinement, opaque)

        >>> from gsbench.gaussians.trainable import LearningRates
        >>> from gsbench.raster.contract import Case
        >>> initial = Case(16, 12, 20, sh_degree=0).gaussians().map(Tensor.float)
        >>> gaussians = TrainableGaussians(initial, LearningRates(), 1.0)
        >>> densifier = CloneOpaque(interval=50, opacity=0.5)
        >>> densifier.begin(gaussians.values, DensifyContext(extent=1.0))
        >>> densifier.refine(49, gaussians, torch.Generator())
        >>> event = densifier.refine(50, gaussians, torch.Generator())
        >>> event.before, event.cloned, event.after
        (20, 9, 29)
    """

    STATISTICS: ClassVar[Mapping[str, torch.dtype | Statistic]] = {}
    SWITCHES: ClassVar[Mapping[str, Switch]] = {}
    needs_absolute_gradient: bool = False
    needs_footprint: bool = False  # ``RenderOutput.footprint``, which not every rasterizer gives
    needs_splitting_matrix: bool = False  # ``RenderOutput.splitting_probe``, likewise

    context: DensifyContext
    lineage: Lineage
    statistics: dict[str, Tensor]
    strictness: float = 1.0  # factor on the thresholds of growth, moved by a governor (`Budgeted`)
    cull: float = 1.0  # factor on the opacity below which Gaussians are pruned

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        own = [vars(parent).get("STATISTICS", {}) for parent in reversed(cls.__mro__)]
        cls.STATISTICS = {name: dtype for table in own for name, dtype in table.items()}

    def __post_init__(self) -> None:
        """Check the hyper-parameters against their annotations; a subclass adds the rules between them."""
        check_settings(self, "densify")

    @property
    def most_gaussians(self) -> int | None:
        """The limit on the number of Gaussians, ``max_gaussians`` where a class has that; None: no limit."""
        return getattr(self, "max_gaussians", None)

    def prepare(self, gaussians: Gaussians) -> Gaussians:
        """The Gaussians that the training starts with, from those of the initial cloud."""
        return gaussians

    def begin(self, gaussians: Gaussians, context: DensifyContext) -> None:
        """Start a training of ``gaussians``: forget all earlier state."""
        self.context = context
        self.lineage = Lineage(len(gaussians))
        self.statistics = self._zeros(len(gaussians), gaussians.means.device)

    def regularizer(self, gaussians: Gaussians) -> Tensor | None:
        """A term added to the loss, or None."""
        return None

    def observe(self, step: int, render: RenderOutput) -> None:
        """Gather statistics of iteration ``step`` (1, 2, …) after its backward pass."""

    def rules(self, refinement: Refinement) -> list[Rule]:
        """The rules that are due at ``refinement.step``, in the order in which they are applied; usually none."""
        return []

    @torch.no_grad()
    def refine(self, step: int, gaussians: TrainableGaussians, rng: torch.Generator) -> RefineEvent | None:
        """Change the Gaussians by the rules that are due, and say what was done; None where nothing was due."""
        refinement = Refinement(step, gaussians, rng, RefineEvent(step=step, before=len(gaussians)))
        rules = self.rules(refinement)
        if not rules:
            return None
        for rule in rules:
            rule(refinement)
        refinement.event.after = len(gaussians)
        return refinement.event

    def after_step(self, step: int, gaussians: TrainableGaussians, rng: torch.Generator) -> None:
        """React to the optimiser step of iteration ``step``, which has just been made."""

    def edit(
        self,
        refinement: Refinement,
        keep: Tensor | None = None,
        append: Gaussians | None = None,
        parents: Tensor | None = None,
        cause: Cause = Cause.INITIAL,
    ) -> None:
        """Keep the Gaussians at the mask ``keep`` [N] (None: all), then append new ones: with their optimiser state,
        lineage and statistics. ``parents`` [A] are the indices, before the edit, of those appended."""
        refinement.gaussians.edit(keep, append)
        self.lineage.edit(keep, parents, cause, refinement.step)
        added = self._zeros(0 if append is None else len(append), refinement.gaussians.device)
        for name, statistic in self.statistics.items():
            kept = statistic if keep is None else statistic[keep]
            self.statistics[name] = torch.cat([kept, added[name]])

    def clone(
        self, refinement: Refinement, selected: Tensor, cause: Cause = Cause.CLONE, revised_opacity: bool = False
    ) -> int:
        """Append a copy of each Gaussian at the mask ``selected`` [N]; returns how many.

        With ``revised_opacity`` each pair is as opaque as the one was (arXiv 2404.06109).
        """
        gaussians = refinement.gaussians
        parents = selected.nonzero().squeeze(-1)  # [C]
        if revised_opacity and len(parents):
            logits = gaussians.values.opacity_logits.detach().clone()
            logits[parents] = revised_logits(logits[parents])
            gaussians.overwrite("opacity_logits", logits, where=selected)
        copies = gaussians.values.detach().select(parents)
        self.edit(refinement, append=copies, parents=parents, cause=cause)
        return len(parents)

    def split(
        self,
        refinement: Refinement,
        selected: Tensor,
        child_log_scales: Tensor,
        children: int,
        cause: Cause,
        revised_opacity: bool = False,
        keep_parent: bool = False,
        sampled: bool = True,
    ) -> int:
        """Replace the Gaussians at the mask ``selected`` [N] by children with scales ``child_log_scales`` [S, 3];
        returns how many more there are than before."""
        parents = selected.nonzero().squeeze(-1)  # [S]
        chosen = refinement.gaussians.values.detach().select(parents)
        new = split(chosen, children, child_log_scales, refinement.rng, sampled)
        if revised_opacity:
            new.opacity_logits = revised_logits(new.opacity_logits)
        keep = None if keep_parent else ~selected
        self.edit(refinement, keep=keep, append=new, parents=parents.repeat(children), cause=cause)
        return len(new) - (0 if keep_parent else len(parents))

    def remove(self, refinement: Refinement, faint: Tensor, others: Tensor | None = None) -> None:
        """Remove the Gaussians at the mask ``faint`` [N], counted as pruned by opacity, and at ``others`` [N], counted
        as pruned by size; those in both count as faint."""
        gone = faint if others is None else faint | others
        refinement.event.pruned_opacity += int(faint.sum())
        refinement.event.pruned_size += int((gone & ~faint).sum())
        self.edit(refinement, keep=~gone)

    def reset_statistics(self, refinement: Refinement) -> None:
        """The rule that ends a round: gather anew."""
        self.statistics = self._zeros(len(refinement.gaussians), refinement.gaussians.device)

    def state_dict(self) -> dict[str, Any]:
        """The state as tensors and plain values; with the same hyper-parameters, ``load_state_dict`` goes on from
        it."""
        return {
            "lineage": self.lineage.state_dict(),
            "statistics": {name: statistic.clone() for name, statistic in self.statistics.items()},
        }

    def load_state_dict(self, state: dict[str, Any], context: DensifyContext) -> None:
        self.context = context
        self.lineage = Lineage.from_state(state["lineage"])
        saved = state["statistics"]
        self.statistics = {name: saved[name].to(context.device, copy=True) for name in self.STATISTICS}

    def _zeros(self, count: int, device: torch.device) -> dict[str, Tensor]:
        kinds = {name: Statistic(k) if isinstance(k, torch.dtype) else k for name, k in self.STATISTICS.items()}
        return {name: torch.zeros(count, *k.shape, dtype=k.dtype, device=device) for name, k in kinds.items()}


class NoDensifier(Densifier):
    """``densify=none``: the initial Gaussians are only optimised."""
