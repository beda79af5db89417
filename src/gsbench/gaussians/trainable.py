"""Gaussians together with their Adam optimiser: the one place that edits optimiser state."""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch import Tensor

from gsbench.gaussians.model import MAX_SH_DEGREE, Gaussians
from gsbench.gaussians.paper_values import LearningRates

ADAM_EPSILON = 1e-15  # 3DGS


class TrainableGaussians:
    """Raw parameters as leaves of the graph, one Adam group each.

    Adding, removing or overwriting Gaussians goes through ``edit``: it keeps parameters and moments in step. As in
    3DGS, an edited parameter is a new leaf without gradient, so the optimiser step of that iteration passes it over.
    """

    def __init__(self, gaussians: Gaussians, rates: LearningRates, spatial_scale: float) -> None:
        self.rates = rates
        self.spatial_scale = spatial_scale
        # The parameters with their gradients, as they are after the last step, ``edit`` or ``overwrite``.
        self.values = gaussians.map(lambda tensor: tensor.detach().clone().requires_grad_(True))
        initial = {
            "means": rates.position(0) * spatial_scale,
            "log_scales": rates.scale,
            "quaternions": rates.rotation,
            "opacity_logits": rates.opacity,
            "sh_dc": rates.sh_dc,
            "sh_rest": rates.sh_rest,
        }
        fused = self.values.means.device.type in ("cpu", "cuda")
        self.optimizer = torch.optim.Adam(
            [{"params": [tensor], "lr": initial[name], "name": name} for name, tensor in self.values.tensors().items()],
            lr=0.0,
            eps=ADAM_EPSILON,
            fused=fused,
        )

    def __len__(self) -> int:
        return len(self.values)

    @property
    def device(self) -> torch.device:
        return self.values.means.device

    @property
    def position_rate(self) -> float:
        """The present learning rate of the means, world units."""
        return self._rate("means")

    def set_step(self, step: float) -> None:
        """Set the learning rate of the means for iteration ``step`` (1, 2, …)."""
        self._group("means")["lr"] = self.rates.position(step) * self.spatial_scale

    def set_rate(self, name: str, rate: float) -> None:
        """Set the learning rate of the parameter ``name``; that of the means is set anew in each iteration."""
        self._group(name)["lr"] = rate

    def optimizer_step(self, sh_degree: int = MAX_SH_DEGREE, visible: Tensor | None = None) -> None:
        """Adam on every parameter that has a gradient, then forget the gradients.

        With ``visible`` [N] only those Gaussians move and update their moments, a departure from the baseline (the rest
        then keep their momentum instead of coasting on it). At ``sh_degree`` 0 the gradient of ``sh_rest`` is zero: its
        moments stay zero, and only Adam's count advances, which is the same and costs nothing.
        """
        if sh_degree == 0 and self.values.means.grad is not None:
            self.values.sh_rest.grad = None
            self._state(self.values.sh_rest)["step"] += 1
        if visible is None:
            self.optimizer.step()
        else:
            self._step_visible(visible.nonzero().squeeze(-1))
        self.optimizer.zero_grad(set_to_none=True)

    def _rate(self, name: str) -> float:
        return float(self._group(name)["lr"])

    def _state(self, parameter: Tensor) -> dict[str, Tensor]:
        """Adam's state of ``parameter``, made as torch makes it if there is none yet."""
        state = self.optimizer.state[parameter]
        if not state:
            state["step"] = torch.zeros((), dtype=torch.float32, device=parameter.device)
            state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
        return state

    @torch.no_grad()
    def _step_visible(self, index: Tensor) -> None:
        """Adam (Kingma and Ba 2015) on the rows ``index`` [V] alone; the count of steps is shared by all rows."""
        for group in self.optimizer.param_groups:
            parameter = group["params"][0]
            if parameter.grad is None:
                continue
            state, (beta1, beta2) = self._state(parameter), group["betas"]
            state["step"] += 1
            step, gradient = float(state["step"]), parameter.grad[index]
            first = state["exp_avg"][index].lerp_(gradient, 1 - beta1)
            second = state["exp_avg_sq"][index].mul_(beta2).addcmul_(gradient, gradient, value=1 - beta2)
            state["exp_avg"][index], state["exp_avg_sq"][index] = first, second
            spread = (second / (1 - beta2**step)).sqrt_().add_(group["eps"])
            parameter[index] -= group["lr"] / (1 - beta1**step) * first / spread

    @torch.no_grad()
    def edit(self, keep: Tensor | None = None, append: Gaussians | None = None) -> None:
        """Keep the Gaussians at the boolean mask ``keep`` [N] (None: all), then append new ones with zero moments."""
        for name, old in self.values.tensors().items():
            added = None if append is None else getattr(append, name).detach()
            self._replace(name, _edited(old.detach(), keep, added), keep, added)

    @torch.no_grad()
    def overwrite(self, name: str, values: Tensor, where: Tensor | None = None) -> None:
        """Set parameter ``name`` to ``values`` (same shape) and zero its moments (at the mask ``where`` [N], or
        all)."""
        parameter = getattr(self.values, name)
        if values.shape != parameter.shape:
            raise ValueError(f"overwrite: {name} has shape {tuple(parameter.shape)}, got {tuple(values.shape)}")
        state = self._replace(name, values.detach().clone())
        for moment in ("exp_avg", "exp_avg_sq"):
            if moment in state:
                if where is None:
                    state[moment].zero_()
                else:
                    state[moment][where] = 0

    def _replace(
        self, name: str, values: Tensor, keep: Tensor | None = None, added: Tensor | None = None
    ) -> dict[str, Tensor]:
        group = self._group(name)
        state = self.optimizer.state.pop(group["params"][0], {})
        for moment in ("exp_avg", "exp_avg_sq"):
            if moment in state:
                state[moment] = _edited(state[moment], keep, None if added is None else torch.zeros_like(added))
        parameter = values.contiguous().requires_grad_(True)
        group["params"][0] = parameter
        if state:  # Adam's ``step`` is shared by a group and stays
            self.optimizer.state[parameter] = state
        setattr(self.values, name, parameter)
        return state

    def _group(self, name: str) -> dict[str, Any]:
        return next(group for group in self.optimizer.param_groups if group["name"] == name)

    def state_dict(self) -> dict[str, object]:
        """The state that a resumed training needs, sharing memory with this object: save it before the next step."""
        return {
            "gaussians": {name: tensor.detach() for name, tensor in self.values.tensors().items()},
            "optimizer": self.optimizer.state_dict(),
        }

    @classmethod
    def load(
        cls, state: dict[str, Any], rates: LearningRates, spatial_scale: float, device: torch.device | None = None
    ) -> TrainableGaussians:
        """The inverse of ``state_dict``, on ``device`` (None: where the state is); copies."""
        gaussians = Gaussians(**state["gaussians"]).map(lambda tensor: tensor.to(device))
        trainable = cls(gaussians, rates, spatial_scale)
        trainable.optimizer.load_state_dict(copy.deepcopy(state["optimizer"]))  # torch itself would share the moments
        return trainable


def _edited(old: Tensor, keep: Tensor | None, added: Tensor | None) -> Tensor:
    kept = old if keep is None else old[keep]
    return kept if added is None else torch.cat([kept, added.to(kept)])
