"""Gaussians together with their Adam optimiser: the one place that edits optimiser state."""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch import Tensor

from gsbench.gaussians.deferred import Coasting, DeferredHarmonics
from gsbench.gaussians.model import MAX_SH_DEGREE, Gaussians
from gsbench.gaussians.paper_values import LearningRates

ADAM_EPSILON = 1e-15  # 3DGS


class TrainableGaussians:
    """Raw parameters as leaves of the graph, one Adam group each.

    Adding, removing or overwriting Gaussians goes through ``edit``: it keeps parameters and moments in step. As in
    3DGS, an edited parameter is a new leaf without gradient, so the optimiser step of that iteration passes it over.

    After ``defer_harmonics`` the harmonics of Gaussians that no view shows stay behind the others' (see
    `gsbench.gaussians.deferred`). Nobody who uses ``values`` notices: looking at ``values.sh_rest`` makes the missed
    steps first, and turns a gradient that a rasterizer left as factors into ``values.sh_rest.grad``.
    """

    def __init__(self, gaussians: Gaussians, rates: LearningRates, spatial_scale: float) -> None:
        self.rates = rates
        self.spatial_scale = spatial_scale
        self.leaves = gaussians.map(lambda tensor: tensor.detach().clone().requires_grad_(True))
        self.deferred: DeferredHarmonics | None = None
        initial = {
            "means": rates.position(0) * spatial_scale,
            "log_scales": rates.scale,
            "quaternions": rates.rotation,
            "opacity_logits": rates.opacity,
            "sh_dc": rates.sh_dc,
            "sh_rest": rates.sh_rest,
        }
        fused = self.leaves.means.device.type in ("cpu", "cuda")
        self.optimizer = torch.optim.Adam(
            [{"params": [tensor], "lr": initial[name], "name": name} for name, tensor in self.leaves.tensors().items()],
            lr=0.0,
            eps=ADAM_EPSILON,
            fused=fused,
        )

    def __len__(self) -> int:
        return len(self.leaves)

    @property
    def values(self) -> Gaussians:
        """The parameters as they are after the last step, with their gradients; ``edit`` and ``overwrite`` are seen."""
        return self.leaves if self.deferred is None else _SettledOnSight(self)

    @property
    def device(self) -> torch.device:
        return self.leaves.means.device

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
        if sh_degree == 0 and self.leaves.means.grad is not None:
            self.leaves.sh_rest.grad = None
            if self.deferred is not None:
                self.deferred.gradient = None
            self._count_harmonics_step()
        elif self.deferred is not None:
            self._step_deferred(visible)
        if visible is None:
            self.optimizer.step()
        else:
            self._step_visible(visible.nonzero().squeeze(-1))
        self.optimizer.zero_grad(set_to_none=True)

    def defer_harmonics(self, deferred: bool = True) -> None:
        """Step harmonics from now on where a rasterizer sees them (or, with ``False``, all of them again)."""
        if not deferred:
            self.settle()
            self.deferred = None
        elif self.deferred is None:
            parameter = self.leaves.sh_rest
            state = self._state(parameter)
            step = int(state["step"])
            last = torch.full((len(self),), step, dtype=torch.int32, device=parameter.device)
            self.deferred = DeferredHarmonics(parameter, state["exp_avg"], state["exp_avg_sq"], last, Coasting(step))

    def settle(self) -> None:
        """Make all steps of harmonics that were put off, and leave their gradient as autograd would have."""
        if self.deferred is not None:
            self.deferred.settle()
            self.deferred.flatten_gradient()

    def snapshot(self) -> Gaussians:
        """The parameters as they are after the last step, detached; what ``deferred`` puts off stays put off."""
        if self.deferred is None:
            return self.leaves.detach()
        return Gaussians(**self.leaves.detach().tensors() | {"sh_rest": self.deferred.settled()[0]})

    def _step_deferred(self, visible: Tensor | None) -> None:
        """Adam on the harmonics of the Gaussians seen, if their gradient is there as factors and as nothing else."""
        assert self.deferred is not None
        if visible is not None or self.leaves.sh_rest.grad is not None:
            self.deferred.flatten_gradient()
        if self.leaves.sh_rest.grad is not None:  # somebody looked: a step like that of any other parameter
            self.deferred.settle()
            self.deferred.coasting.advance(self._rate("sh_rest"))
            self.deferred.last.fill_(self.deferred.coasting.step)
        elif self.deferred.gradient is not None:
            self.deferred.gradient.step(self.deferred, self._rate("sh_rest"), ADAM_EPSILON)
            self.deferred.gradient = None
            self._count_harmonics_step()

    def _count_harmonics_step(self) -> None:
        """Count a step of ``sh_rest`` that torch's optimiser does not make."""
        self._state(self.leaves.sh_rest)["step"] += 1
        if self.deferred is not None:
            self.deferred.coasting.advance(self._rate("sh_rest"))

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
        for name, old in self.leaves.tensors().items():
            added = None if append is None else getattr(append, name).detach()
            self._replace(name, _edited(old.detach(), keep, added), keep, added)

    @torch.no_grad()
    def overwrite(self, name: str, values: Tensor, where: Tensor | None = None) -> None:
        """Set parameter ``name`` to ``values`` (same shape) and zero its moments (at the mask ``where`` [N], or
        all)."""
        parameter = getattr(self.leaves, name)
        if name == "sh_rest":
            self.settle()
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
        setattr(self.leaves, name, parameter)
        if name == "sh_rest" and self.deferred is not None:
            coasting = self.deferred.coasting
            new = None if added is None else torch.full((len(added),), coasting.step, dtype=torch.int32)
            last = _edited(self.deferred.last, keep, new)
            self.deferred = DeferredHarmonics(parameter, state["exp_avg"], state["exp_avg_sq"], last, coasting)
        return state

    def _group(self, name: str) -> dict[str, Any]:
        return next(group for group in self.optimizer.param_groups if group["name"] == name)

    def state_dict(self) -> dict[str, object]:
        """The state that a resumed training needs, sharing memory with this object: save it before the next step.

        Saving changes nothing: harmonics that are behind are saved as they are, with what they have missed.
        """
        state: dict[str, object] = {
            "gaussians": {name: tensor.detach() for name, tensor in self.leaves.tensors().items()},
            "optimizer": self.optimizer.state_dict(),
        }
        if self.deferred is not None:
            state["deferred"] = {"last": self.deferred.last, "drift": self.deferred.coasting.saved()}
        return state

    @classmethod
    def load(
        cls, state: dict[str, Any], rates: LearningRates, spatial_scale: float, device: torch.device | None = None
    ) -> TrainableGaussians:
        """The inverse of ``state_dict``, on ``device`` (None: where the state is); copies."""
        gaussians = Gaussians(**state["gaussians"]).map(lambda tensor: tensor.to(device))
        trainable = cls(gaussians, rates, spatial_scale)
        trainable.optimizer.load_state_dict(copy.deepcopy(state["optimizer"]))  # torch itself would share the moments
        if "deferred" in state:
            trainable.defer_harmonics()
            assert trainable.deferred is not None
            trainable.deferred.last = state["deferred"]["last"].to(trainable.device, copy=True)
            trainable.deferred.coasting = Coasting(trainable.deferred.coasting.step, state["deferred"]["drift"])
        return trainable


class _SettledOnSight(Gaussians):
    """The leaves of a `TrainableGaussians`, whose harmonics are settled when somebody asks for them."""

    def __init__(self, trainable: TrainableGaussians) -> None:
        self._trainable = trainable

    def __getattr__(self, name: str) -> Tensor:  # called for what is not set, so for all six tensors
        if name.startswith("_"):
            raise AttributeError(name)
        if name == "sh_rest":
            self._trainable.settle()
        return getattr(self._trainable.leaves, name)


def _edited(old: Tensor, keep: Tensor | None, added: Tensor | None) -> Tensor:
    kept = old if keep is None else old[keep]
    return kept if added is None else torch.cat([kept, added.to(kept)])
