"""Gaussians with their Adam optimiser. No other module edits optimiser state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import torch
from torch import Tensor

from gsbench.gaussians.model import MAX_SH_DEGREE, Gaussians
from gsbench.gaussians.paper_values import ADAM_BETAS, ADAM_EPSILON, LearningRates
from gsbench.words import attributes_of, no_such


@dataclass
class ParameterState:
    """The optimiser's state of one parameter: rate, number of steps, and ``tensors``.

    Those of Adam are its moments ``first`` and ``second``, in the parameter's shape. Tensors with a
    row for each Gaussian follow the edits of densifiers; new rows are 0.
    """

    rate: float
    step: int
    tensors: dict[str, Tensor]

    @property
    def first(self) -> Tensor:
        return self.tensors["first"]

    @property
    def second(self) -> Tensor:
        return self.tensors["second"]

    @property
    def factors(self) -> tuple[float, float]:
        """Factors (a, b) of Adam's step t, which is a m / (b sqrt(v) + eps) for the moments m, v.

        With m' = m / (1 - b1^t) and v' = v / (1 - b2^t), it is rate m' / (sqrt(v') + eps).
        """
        beta1, beta2 = ADAM_BETAS
        return self.rate / (1 - beta1**self.step), (1 - beta2**self.step) ** -0.5

    def edit(self, count: int, keep: Tensor | None, added: int) -> None:
        """Keep the rows at ``keep`` [``count``] (None: all) of each tensor, then add ``added``."""
        for name, tensor in self.rows(count):
            new = tensor.new_zeros(added, *tensor.shape[1:]) if added else None
            self.tensors[name] = _edited(tensor, keep, new)

    def rows(self, count: int) -> list[tuple[str, Tensor]]:
        """The tensors that have a row for each of ``count`` Gaussians."""
        return [
            (name, tensor)
            for name, tensor in self.tensors.items()
            if tensor.dim() and len(tensor) == count
        ]


class Optimizer(Protocol):
    """An optimiser of the user's (``train.optimizer``), instead of Adam.

    ``init`` makes the state of a parameter [N, …] as tensors by name. ``step`` changes the
    parameter in place by its ``gradient``; ``rate`` is its learning rate at this iteration, and
    ``count`` the number of its steps (1, 2, …). With the attribute ``groups``, it steps only these
    fields of `Gaussians`, and Adam the others.
    """

    def init(self, parameter: Tensor) -> dict[str, Tensor]: ...

    def step(
        self, parameter: Tensor, gradient: Tensor, state: dict[str, Tensor], rate: float, count: int
    ) -> None: ...


class Update(NamedTuple):
    """A parameter [N, ...] to update with its ``gradient`` and Adam's ``state``.

    The gradient is 0 from column ``active`` on (None: nowhere), where it may be undefined.
    ``further``, which is defined everywhere, is added to it.
    """

    parameter: Tensor
    gradient: Tensor
    state: ParameterState
    active: int | None = None
    further: Tensor | None = None


class StepAll(Protocol):
    """Applies Adam to parameters in place, for their step ``state.step`` (1, 2, …).

    With ``seen`` [N], gradients are 0 where it is 0, and may be undefined there. With ``visible``
    [N], only Gaussians where it is not 0, and their moments, are updated.
    """

    def __call__(
        self, updates: Sequence[Update], seen: Tensor | None = None, visible: Tensor | None = None
    ) -> None: ...


@dataclass(frozen=True)
class KnownGradients:
    """Gradients by ``parameters``, in their order, computed without autograd.

    They are those of a step with harmonics up to ``sh_degree``. See `Update` for ``further``, and
    `StepAll` for ``seen`` and ``visible``.
    """

    parameters: list[Tensor]
    gradients: list[Tensor]
    further: list[Tensor | None]
    seen: Tensor  # [N] int32
    visible: Tensor | None  # [N]
    sh_degree: int

    def updates(self, states: Sequence[ParameterState | None]) -> list[Update]:
        """The updates of the parameters with a state and a gradient; a state None leaves one out.

        Harmonics, the last parameter, have gradients up to the degree: at degree 0, none.
        """
        rest = 3 * ((self.sh_degree + 1) ** 2 - 1)
        active: list[int | None] = [*[None] * (len(self.parameters) - 1), rest]
        found = zip(self.parameters, self.gradients, states, active, self.further, strict=True)
        return [
            Update(parameter, gradient, state, columns, further)
            for parameter, gradient, state, columns, further in found
            if state is not None and columns != 0
        ]


class TrainableGaussians:
    """Raw parameters as leaves of the autograd graph, each with its Adam state.

    ``edit`` adds and removes Gaussians, and ``overwrite`` sets values; both change parameters and
    moments together. As in 3DGS, an edited parameter is a new leaf without gradient, so the
    optimiser step of that iteration skips it.

    `torch.optim.Adam` is not used, because the first object of that class imports torch's compiler,
    which takes 1.5 CPU-seconds in each process.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        rates: LearningRates,
        spatial_scale: float,
        step_all: StepAll | None = None,
        optimizer: Optimizer | None = None,
    ) -> None:
        """``step_all`` applies Adam to whole parameters (None: `torch_adam`).

        ``optimizer`` steps the parameters in its ``groups`` (all, if it has none) instead.
        """
        self.rates = rates
        self.spatial_scale = spatial_scale
        self.step_all = step_all or torch_adam
        self.optimizer = optimizer
        # the current parameters; ``edit`` and ``overwrite`` replace its tensors
        self.values = gaussians.map(lambda tensor: tensor.detach().clone().requires_grad_(True))
        initial = self.base_rates(rates.position(0) * spatial_scale)
        self.adam = {}
        for name, tensor in self.values.tensors().items():
            detached = tensor.detach()
            if (own := self._own(name)) is not None:
                tensors = own.init(detached)
            else:
                tensors = {moment: torch.zeros_like(detached) for moment in ("first", "second")}
            self.adam[name] = ParameterState(initial[name], 0, tensors)

    if not TYPE_CHECKING:  # else a type checker would allow any name

        def __getattr__(self, name: str) -> Any:
            names = attributes_of(Gaussians)
            raise AttributeError(no_such("TrainableGaussians", name, names, inside="values."))

    def __len__(self) -> int:
        return len(self.values)

    @property
    def device(self) -> torch.device:
        return self.values.means.device

    @property
    def position_rate(self) -> float:
        """The current learning rate of the means, world units."""
        return self.adam["means"].rate

    def _own(self, name: str) -> Optimizer | None:
        """The user's optimiser of parameter ``name``; None for Adam."""
        groups = getattr(self.optimizer, "groups", None)
        return self.optimizer if groups is None or name in groups else None

    def base_rates(self, position: float) -> dict[str, float]:
        """The rates of 3DGS by parameter, with ``position`` for the means."""
        return {
            "means": position,
            "log_scales": self.rates.scale,
            "quaternions": self.rates.rotation,
            "opacity_logits": self.rates.opacity,
            "sh_dc": self.rates.sh_dc,
            "sh_rest": self.rates.sh_rest,
        }

    def set_step(self, step: float) -> None:
        """Set the learning rate of the means for iteration ``step`` (1, 2, …)."""
        self.adam["means"].rate = self.rates.position(step) * self.spatial_scale

    def set_rate(self, name: str, rate: float) -> None:
        """Set the learning rate of parameter ``name``; `set_step` overwrites that of the means."""
        self.adam[name].rate = rate

    @torch.no_grad()
    def optimizer_step(self, sh_degree: int = MAX_SH_DEGREE, visible: Tensor | None = None) -> None:
        """Apply Adam to every parameter that has a gradient, then clear the gradients.

        With the mask ``visible`` [N], only visible Gaussians and their moments are updated. This
        departs from 3DGS, where momentum also moves the others.
        """
        # At degree 0 the gradient of sh_rest is zero, so its moments stay zero: Adam would only
        # count the step.
        if sh_degree == 0 and self.values.means.grad is not None:
            self.values.sh_rest.grad = None
            self.adam["sh_rest"].step += 1
        updates = []
        for name, parameter in self.values.tensors().items():
            if parameter.grad is not None:
                state = self.adam[name]
                state.step += 1
                if (own := self._own(name)) is not None:
                    own.step(parameter, parameter.grad, state.tensors, state.rate, state.step)
                else:
                    active = 3 * ((sh_degree + 1) ** 2 - 1) if name == "sh_rest" else None
                    updates.append(Update(parameter, parameter.grad, state, active))
                parameter.grad = None
        self.step_all(updates, None, visible)

    def count_step(self) -> list[ParameterState]:
        """Count a step of all parameters, which the caller makes; return their states in order."""
        for state in self.adam.values():
            state.step += 1
        return [*self.adam.values()]

    def advance(self, known: KnownGradients) -> list[ParameterState | None]:
        """Count a step with ``known`` gradients; return the state of each parameter to update.

        It is None for a parameter that was replaced since.
        """
        pairs = zip(self.values.tensors().items(), known.parameters, strict=True)
        states = [self.adam[name] if parameter is own else None for (name, parameter), own in pairs]
        for state in filter(None, states):
            state.step += 1
        return states

    @torch.no_grad()
    def apply(self, known: KnownGradients, states: list[ParameterState | None]) -> None:
        """Apply Adam with ``known`` gradients to the parameters with a state from `advance`."""
        self.step_all(known.updates(states), known.seen, known.visible)

    @torch.no_grad()
    def edit(self, keep: Tensor | None = None, append: Gaussians | None = None) -> None:
        """Keep the Gaussians at the mask ``keep`` [N] (None: all), then append new ones.

        The moments of new Gaussians are zero.
        """
        for name, old in self.values.tensors().items():
            added = None if append is None else getattr(append, name).detach()
            self._replace(name, _edited(old.detach(), keep, added), keep, added)

    @torch.no_grad()
    def overwrite(self, name: str, values: Tensor, where: Tensor | None = None) -> None:
        """Set parameter ``name`` to ``values``; clear its moments at ``where`` [N] (None: all)."""
        parameter = getattr(self.values, name)
        if values.shape != parameter.shape:
            raise ValueError(
                f"overwrite: {name} has shape {tuple(parameter.shape)}, got {tuple(values.shape)}"
            )
        self._replace(name, values.clone())
        for _, tensor in self.adam[name].rows(len(values)):
            tensor[... if where is None else where] = 0

    def _replace(
        self, name: str, values: Tensor, keep: Tensor | None = None, added: Tensor | None = None
    ) -> None:
        """Replace parameter ``name`` and edit its state alike; the step count does not change."""
        count = len(getattr(self.values, name))
        self.adam[name].edit(count, keep, 0 if added is None else len(added))
        setattr(self.values, name, values.contiguous().requires_grad_(True))

    def state_dict(self) -> dict[str, object]:
        """Return the state for a checkpoint. It shares memory: save it before the next step."""
        return {
            "gaussians": {name: tensor.detach() for name, tensor in self.values.tensors().items()},
            "adam": {
                name: {**vars(state), "tensors": dict(state.tensors)}
                for name, state in self.adam.items()
            },
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a copy of ``state_dict``, on the present device."""
        device = self.device
        self.values = Gaussians(**state["gaussians"]).map(
            lambda tensor: tensor.to(device, copy=True).requires_grad_(True)
        )
        for name, saved in state["adam"].items():
            tensors = {key: value.to(device, copy=True) for key, value in saved["tensors"].items()}
            self.adam[name] = ParameterState(saved["rate"], saved["step"], tensors)


def torch_adam(
    updates: Sequence[Update], seen: Tensor | None = None, visible: Tensor | None = None
) -> None:
    """Apply Adam (Kingma and Ba 2015, algorithm 1) in torch, on any device and in any precision.

    Gradients must be defined everywhere, as autograd's are. As in torch, epsilon is outside the
    root.
    """
    beta1, beta2 = ADAM_BETAS
    rows = slice(None) if visible is None else visible.nonzero().squeeze(-1)
    for parameter, gradients, state, _, further in updates:
        if seen is not None or further is not None:
            raise NotImplementedError("torch_adam: a gradient is one tensor, defined everywhere")
        gradient = gradients[rows]
        first = state.first[rows].lerp_(gradient, 1 - beta1)
        second = state.second[rows].mul_(beta2).addcmul_(gradient, gradient, value=1 - beta2)
        state.first[rows], state.second[rows] = first, second
        denominator = (second / (1 - beta2**state.step)).sqrt_().add_(ADAM_EPSILON)
        parameter[rows] -= state.rate / (1 - beta1**state.step) * first / denominator


def _edited(old: Tensor, keep: Tensor | None, added: Tensor | None) -> Tensor:
    kept = old if keep is None else old[keep]
    return kept if added is None else torch.cat([kept, added.to(kept)])
