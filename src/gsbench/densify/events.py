"""What a refinement did, and where every Gaussian came from."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from enum import IntEnum

import torch
from torch import Tensor


class Cause(IntEnum):
    """Why a Gaussian exists."""

    INITIAL = 0
    CLONE = 1
    SPLIT_GRADIENT = 2
    SPLIT_VOLUME = 3
    RELOCATED = 4
    ADDED = 5


@dataclass
class RefineEvent:
    """One refinement, as a closed record of counts by cause.

    ``after = before + cloned + split_gradient + split_volume + added - pruned_opacity - pruned_size``, where a split
    counts the Gaussians that it adds beyond its parent (one per parent, for two children). ``blocked_by_cap`` counts
    candidates that the budget refused. ``isotropic_resplit`` counts parents split by volume whose children are still
    above the threshold, so that they are split again at the next refinement; ``vanished`` counts parents split by
    volume whose children are far below a pixel. ``relocated`` moves dead Gaussians and changes no count (3DGS-MCMC).
    """

    step: int
    before: int
    after: int = 0
    cloned: int = 0
    split_gradient: int = 0
    split_volume: int = 0
    added: int = 0
    relocated: int = 0
    pruned_opacity: int = 0
    pruned_size: int = 0
    blocked_by_cap: int = 0
    isotropic_resplit: int = 0
    vanished: int = 0
    opacity_reset: bool = False
    volume_threshold: float | None = None

    def as_dict(self) -> dict[str, object]:
        """The record as written to ``events.jsonl``."""
        return {key: value for key, value in asdict(self).items() if value is not None}

    @staticmethod
    def count_names() -> tuple[str, ...]:
        """The fields that can be summed over a trial."""
        return tuple(
            f.name for f in fields(RefineEvent) if f.name not in ("step", "before", "after", "volume_threshold")
        )


def sum_events(events: list[dict[str, object]]) -> dict[str, int]:
    """Totals by cause over the records of ``events.jsonl``."""
    return {name: sum(int(event.get(name, 0)) for event in events) for name in RefineEvent.count_names()}  # type: ignore[call-overload]


class Lineage:
    """An identity, a parent and a cause for every Gaussian that ever existed in a training.

    ``ids`` [N] names the Gaussians that live now; ``parents``, ``causes`` and ``steps`` [T] hold the history of all T.
    """

    def __init__(self, num_gaussians: int) -> None:
        self.ids = torch.arange(num_gaussians)  # [N]
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
        """How many of the living Gaussians each cause made."""
        counts = torch.bincount(torch.cat(self._causes)[self.ids].long(), minlength=len(Cause))
        return {cause.name.lower(): int(counts[cause]) for cause in Cause}

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
        lineage.ids = state["ids"].clone()
        lineage._parents, lineage._causes, lineage._steps = [state["parents"]], [state["causes"]], [state["steps"]]
        lineage._total = len(state["parents"])
        return lineage
