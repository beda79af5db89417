"""The contract of a densifier: hyper-parameters, saved state, and the record of refinements."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from gsbench.densify.lineage import Lineage
from gsbench.densify.scores import TrainingViews, revised_logits, standard_normal
from gsbench.events import Cause, RefineEvent
from gsbench.gaussians.model import Gaussians
from gsbench.gaussians.trainable import TrainableGaussians
from gsbench.raster.base import RenderOutput
from gsbench.settings import Switch, check_settings
from gsbench.words import NamesAttributes

CPU = torch.device("cpu")


@dataclass(frozen=True)
class DensifyContext(NamesAttributes):
    """Facts of a training that its densifier may use."""

    extent: float  # size of the scene in world units: 3DGS's cameras_extent
    white_background: bool = False
    device: torch.device = CPU  # of the Gaussians
    views: TrainingViews | None = None

    @property
    def training_views(self) -> TrainingViews:
        """Return ``views``, which the trainer always sets. Raises RuntimeError if they are None."""
        if self.views is None:
            raise RuntimeError("this densifier needs training views: set DensifyContext.views")
        return self.views


@dataclass
class Refinement(NamesAttributes):
    """One refinement in progress: what its rules read and change, and the record of their edits."""

    step: int
    gaussians: TrainableGaussians
    rng: torch.Generator
    event: RefineEvent
    # ``cap=governor`` (`Budgeted`) sets both: factors on the growth thresholds, and on the opacity
    # below which Gaussians are pruned
    strictness: float = 1.0
    cull: float = 1.0


Rule = Callable[[Refinement], None]


class Statistic(NamedTuple):
    """A statistic with several numbers per Gaussian.

    ``Statistic(torch.float32, (3, 3))`` is [N, 3, 3].
    """

    dtype: torch.dtype
    shape: tuple[int, ...]


class Densifier:
    """Base of all densifiers. By itself it never changes the Gaussians.

    A subclass is a dataclass of hyper-parameters; their annotations say which values are allowed.
    In every iteration the trainer calls ``regularizer`` before the backward pass, ``observe`` after
    it, then ``refine``, then the optimiser step, then ``after_step``. A subclass defines:

    - ``rules``: what a refinement does;
    - ``STATISTICS``: the statistics that it gathers, in addition to those of its base class;
    - ``SWITCHES``: the parts that ``gsbench ablate`` can turn off (gsbench's own: switches.yaml).

    The state is ``context``, ``lineage`` and ``statistics``. ``statistics`` has one tensor [N] for
    each name in ``STATISTICS`` ([N, …] for a `Statistic` with a shape), zero at the start, on the
    device of the Gaussians. Every ``edit`` updates them (new Gaussians get zero), and checkpoints
    save them.

    Examples:
        A densifier that clones the nearly opaque Gaussians every ``interval`` iterations:

        >>> @dataclass
        ... class CloneOpaque(Densifier):
        ...     interval: int = 100
        ...     opacity: float = 0.9
        ...
        ...     def rules(self, refinement):
        ...         return [self.grow] if refinement.step % self.interval == 0 else []
        ...
        ...     def grow(self, refinement):
        ...         opacities = refinement.gaussians.values.opacity_logits.sigmoid()  # [N]
        ...         opaque = opacities > self.opacity  # [N]
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
    needs_depth: bool = False  # ``RenderOutput.depth`` of each training view
    # the extra output to ask for (``RenderOutput.extra``), which not every rasterizer gives
    needs_extra: str | None = None

    context: DensifyContext
    lineage: Lineage
    statistics: dict[str, Tensor]

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        # A subclass names only its own statistics: merge them with those of its bases.
        tables = [vars(base).get("STATISTICS", {}) for base in reversed(cls.__mro__)]
        cls.STATISTICS = {name: dtype for table in tables for name, dtype in table.items()}

    def __post_init__(self) -> None:
        """Check each hyper-parameter against its annotation. Raises InputError.

        A subclass may add checks that involve several hyper-parameters.
        """
        check_settings(self, "densify")

    @property
    def most_gaussians(self) -> int | None:
        """The largest count during training, ``max_gaussians`` if it is set; None: no limit."""
        return getattr(self, "max_gaussians", None)

    def prepare(self, gaussians: Gaussians) -> Gaussians:
        """Return the Gaussians to start with, given those of the initial cloud."""
        return gaussians

    def begin(self, gaussians: Gaussians, context: DensifyContext) -> None:
        """Start a training of ``gaussians``; forget all earlier state."""
        self.context = context
        self.lineage = Lineage(len(gaussians))
        self.statistics = self._zeros(len(gaussians), gaussians.means.device)

    def regularizer(self, gaussians: Gaussians) -> Tensor | None:
        """Return a term to add to the loss, or None."""
        return None

    def observe(self, step: int, render: RenderOutput) -> None:
        """Gather statistics of iteration ``step`` (1, 2, …) after its backward pass.

        A subclass may have a third argument ``view``, the `gsbench.train.ideas.TrainedView`.
        """

    def rules(self, refinement: Refinement) -> list[Rule]:
        """Return the rules that are due at ``refinement.step``, in order; [] if none is due."""
        return []

    @torch.no_grad()
    def refine(
        self, step: int, gaussians: TrainableGaussians, rng: torch.Generator
    ) -> RefineEvent | None:
        """Apply the rules that are due, without gradients, and return the record of their edits.

        Returns None if no rule is due.
        """
        refinement = Refinement(step, gaussians, rng, RefineEvent(step=step, before=len(gaussians)))
        rules = self.rules(refinement)
        if not rules:
            return None
        for rule in rules:
            rule(refinement)
        refinement.event.after = len(gaussians)
        return refinement.event

    def after_step(self, step: int, gaussians: TrainableGaussians, rng: torch.Generator) -> None:
        """Act after the optimiser step of iteration ``step``; for example, move the means."""

    def edit(
        self,
        refinement: Refinement,
        keep: Tensor | None = None,
        append: Gaussians | None = None,
        parents: Tensor | None = None,
        cause: Cause = Cause.INITIAL,
    ) -> None:
        """Keep the Gaussians at the mask ``keep`` [N] (None: all), then append ``append`` [A].

        Optimiser state, lineage and statistics are edited in the same way. ``parents`` [A] are the
        indices of the parents of ``append``, from before the edit.
        """
        refinement.gaussians.edit(keep, append)
        self.lineage.edit(keep, parents, cause, refinement.step)
        added = self._zeros(0 if append is None else len(append), refinement.gaussians.device)
        for name, statistic in self.statistics.items():
            kept = statistic if keep is None else statistic[keep]
            self.statistics[name] = torch.cat([kept, added[name]])

    def clone(
        self,
        refinement: Refinement,
        selected: Tensor,
        cause: Cause = Cause.CLONE,
        revised_opacity: bool = False,
    ) -> int:
        """Append a copy of each Gaussian at the mask ``selected`` [N]; return the number of copies.

        With ``revised_opacity``, a Gaussian and its copy together are as opaque as it was before
        (arXiv 2404.06109).
        """
        gaussians = refinement.gaussians
        parents = selected.nonzero().squeeze(-1)  # [C]
        if revised_opacity and len(parents):
            logits = gaussians.values.opacity_logits.clone()
            logits[parents] = revised_logits(logits[parents])
            gaussians.overwrite("opacity_logits", logits, where=selected)
        copies = gaussians.values.select(parents)
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
        """Replace each Gaussian at the mask ``selected`` [N] by ``children`` new ones.

        Returns by how many the count grew. ``child_log_scales`` [S, 3] has one row per selected
        Gaussian. With ``keep_parent``, the parents are kept, too. With ``sampled``, the means of
        children are drawn from the density of their parent; otherwise they are the parent's mean.
        """
        parents = selected.nonzero().squeeze(-1)  # [S]
        new = Gaussians.concatenate([refinement.gaussians.values.select(parents)] * children)
        if sampled:
            # along the axes of each Gaussian
            offsets = standard_normal((len(new), 3), refinement.rng, new.means) * new.scales
            new.means = new.means + (new.rotations @ offsets.unsqueeze(-1)).squeeze(-1)
        new.log_scales = child_log_scales.repeat(children, 1)
        if revised_opacity:
            new.opacity_logits = revised_logits(new.opacity_logits)
        keep = None if keep_parent else ~selected
        self.edit(refinement, keep=keep, append=new, parents=parents.repeat(children), cause=cause)
        return len(new) - (0 if keep_parent else len(parents))

    def split_in_halves(
        self, refinement: Refinement, selected: Tensor, children: Gaussians
    ) -> None:
        """Replace each Gaussian at the mask ``selected`` [N] by two ``children`` [2 S].

        ``children`` has the first halves of all parents, then the second halves. Each parent counts
        as one split.
        """
        parents = selected.nonzero().squeeze(-1)  # [S]
        self.edit(refinement, ~selected, children, parents.repeat(2), Cause.SPLIT_GRADIENT)
        refinement.event.split_gradient += len(parents)

    def remove(self, refinement: Refinement, faint: Tensor, others: Tensor | None = None) -> None:
        """Remove the Gaussians at the masks ``faint`` [N] and ``others`` [N].

        ``faint`` counts as pruned by opacity, ``others`` as pruned by size; a Gaussian in both
        counts as ``faint``.
        """
        pruned = faint if others is None else faint | others
        refinement.event.pruned_opacity += int(faint.sum())
        refinement.event.pruned_size += int((pruned & ~faint).sum())
        self.edit(refinement, keep=~pruned)

    def reset_statistics(self, refinement: Refinement) -> None:
        """Set all statistics to zero. This is the last rule of a round."""
        self.statistics = self._zeros(len(refinement.gaussians), refinement.gaussians.device)

    def state_dict(self) -> dict[str, Any]:
        """Return the state as tensors and plain values.

        A densifier with the same hyper-parameters continues from it after ``load_state_dict``.
        """
        return {
            "lineage": self.lineage.state_dict(),
            "statistics": {name: statistic.clone() for name, statistic in self.statistics.items()},
        }

    def load_state_dict(self, state: dict[str, Any], context: DensifyContext) -> None:
        self.context = context
        self.lineage = Lineage.from_state(state["lineage"])
        saved = state["statistics"]
        self.statistics = {
            name: saved[name].to(context.device, copy=True) for name in self.STATISTICS
        }

    def _zeros(self, count: int, device: torch.device) -> dict[str, Tensor]:
        zeros = {}
        for name, kind in self.STATISTICS.items():
            dtype, shape = (kind, ()) if isinstance(kind, torch.dtype) else kind
            zeros[name] = torch.zeros(count, *shape, dtype=dtype, device=device)
        return zeros


class NoDensifier(Densifier):
    """``densify=none``: the initial Gaussians are only optimised."""
