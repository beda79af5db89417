"""Lineage of Gaussians: the origin of every one."""

from __future__ import annotations

import torch
from torch import Tensor

from gsbench.events import Cause


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
