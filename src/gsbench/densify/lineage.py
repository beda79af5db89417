"""The lineage of Gaussians: what each one came from."""

from __future__ import annotations

import torch
from torch import Tensor

from gsbench.events import Cause


class Lineage:
    """Identity, parent and cause of every Gaussian that ever existed in a training.

    All tensors are on the CPU. ``ids`` [N] are the identities of the present Gaussians. The history
    of all T Gaussians, ``parents``, ``causes`` and ``steps`` [T], is indexed by identity; the
    parent of an initial Gaussian is -1.
    """

    def __init__(self, num_gaussians: int) -> None:
        self.ids = torch.arange(num_gaussians)  # [N]
        self.initial_count = num_gaussians
        # one entry per edit; ``state_dict`` joins them
        self._history = [self._entries(torch.full((num_gaussians,), -1), Cause.INITIAL, 0)]
        self._total = num_gaussians

    @staticmethod
    def _entries(parents: Tensor, cause: Cause, step: int) -> dict[str, Tensor]:
        """The history of new Gaussians, given the identities [A] of their parents."""
        return {
            "parents": parents,
            "causes": torch.full_like(parents, int(cause), dtype=torch.uint8),
            "steps": torch.full_like(parents, step, dtype=torch.int32),
        }

    def edit(self, keep: Tensor | None, parents: Tensor | None, cause: Cause, step: int) -> None:
        """Keep the Gaussians at the mask ``keep`` [N]; then append a child for each parent.

        ``parents`` [A] are indices from before the edit. None keeps all and appends none.
        """
        living = self.ids if keep is None else self.ids[keep.cpu()]
        if parents is not None:
            self._history.append(self._entries(self.ids[parents.cpu()], cause, step))
            living = torch.cat([living, torch.arange(self._total, self._total + len(parents))])
            self._total += len(parents)
        self.ids = living

    def causes_of_living(self) -> dict[str, int]:
        """Count the present Gaussians by cause."""
        counts = torch.bincount(self.state_dict()["causes"][self.ids].long(), minlength=len(Cause))
        return {cause.key: int(counts[cause]) for cause in Cause}

    def state_dict(self) -> dict[str, Tensor]:
        """Return the tensors ``ids``, ``parents``, ``causes``, ``steps``, as in ``lineage.npz``."""
        return {"ids": self.ids} | {
            name: torch.cat([entries[name] for entries in self._history])
            for name in self._history[0]
        }

    @classmethod
    def from_state(cls, state: dict[str, Tensor]) -> Lineage:
        history = {name: tensor.cpu() for name, tensor in state.items()}
        lineage = cls(0)
        lineage.ids = history.pop("ids")
        lineage._history, lineage._total = [history], len(history["parents"])
        lineage.initial_count = int((history["parents"] < 0).sum())
        return lineage
