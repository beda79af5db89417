"""The evaluator, which applies the metrics of a protocol and the user's own metrics to pairs of images."""

import importlib
import math
import traceback
from collections.abc import Mapping, Sequence
from numbers import Real
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsbench.errors import InputError, TrainingError
from gsbench.eval.facts import LPIPS, METRICS, MORE, MetricFacts, facts_of, further_keys, lpips_variants
from gsbench.eval.images import as_unit_range, replace_ignored
from gsbench.eval.measures import MetricContext
from gsbench.eval.metric import MaskedMetric, Metric, UnavailableError
from gsbench.eval.protocol import Protocol


class Evaluator:
    """Computes the metrics of one protocol; loads every network once.

    ``lpips`` names the variants to compute (see `gsbench.eval.facts.lpips_variants`), ``more`` names further metrics of
    gsbench (`further_keys`), and ``extra`` are the user's own metrics by name. ``weights`` is the folder that is
    searched first.

    ``unavailable`` maps each metric that cannot be computed to the reason, in one line. ``awaited`` holds those that
    can be computed once their weights or packages are installed. Both can grow while views are evaluated;
    ``summarize`` then leaves the metric out for all views. ``own`` are the facts of the user's metrics.
    """

    def __init__(
        self,
        protocol: Protocol,
        device: torch.device | str = "cpu",
        lpips: Sequence[str] | None = None,
        flip: bool = True,
        weights: Path | None = None,
        download: bool = True,
        extra: Mapping[str, Metric] = MappingProxyType({}),
        more: Sequence[str] = (),
    ) -> None:
        variants = lpips_variants()
        unknown = [variant for variant in lpips or () if variant not in variants]
        if unknown:
            raise InputError(f"unknown LPIPS variant {unknown[0]!r}; choose among {', '.join(variants)}")
        if unknown := [key for key in more if key not in further_keys()]:
            raise InputError(f"unknown metric {unknown[0]!r}; choose among {', '.join(further_keys())}")
        self.protocol = protocol
        self.device = torch.device(device)
        self.unavailable: dict[str, str] = {}
        self.awaited: set[str] = set()
        self.extra = dict(extra)
        self.more = tuple(sorted(more))
        self.own = {name: facts_of(name, metric) for name, metric in extra.items()}
        wanted = {f"{LPIPS}{variant}" for variant in (variants if lpips is None else lpips)}
        wanted |= {facts.key for facts in METRICS if not facts.setting} | ({"flip"} if flip else set()) | set(more)
        context = MetricContext(protocol, self.device, weights, download)
        self._metrics: dict[str, Metric] = {}
        for facts in METRICS:
            if facts.setting == MORE and facts.key not in wanted:
                continue  # not listed as unavailable, since older results do not know later metrics
            try:
                if facts.key not in wanted:
                    raise UnavailableError(f"not asked for ({facts.setting})")
                self._metrics[facts.key] = _load(facts, context)
            except UnavailableError as error:
                self._leave_out(facts.key, error)
        self._metrics |= extra

    def evaluate_view(
        self,
        render: NDArray[Any] | Tensor,
        ground_truth: NDArray[Any] | Tensor,
        mask: NDArray[np.bool_] | None = None,
    ) -> dict[str, float]:
        """The metrics of one view; images are [H, W, 3], uint8 or floating point in [0, 1].

        Where ``mask`` [H, W] is False, the render is ignored: its pixels are replaced by the photograph's before
        anything is measured, and metrics that average over pixels leave them out (see `MaskedMetric`).

        A metric that cannot be computed is absent and listed in ``unavailable``. Raises ``TrainingError`` if the render
        holds a non-finite value.
        """
        image, target = self._prepare(render), self._prepare(ground_truth)  # [H, W, 3]
        counted = None if mask is None else torch.as_tensor(mask, device=self.device)  # [H, W]
        image = replace_ignored(image, target, None if counted is None else counted[..., None])
        values = {}
        for key, metric in self._metrics.items():
            if key in self.unavailable:
                continue
            try:
                value = self._measure(key, metric, image, target, counted)
                if not math.isfinite(value):
                    raise UnavailableError(f"the value of a view is {value}")
                values[key] = value
            except UnavailableError as error:
                self._leave_out(key, error)
        return values

    def _measure(self, key: str, metric: Metric, image: Tensor, target: Tensor, mask: Tensor | None) -> float:
        try:
            value: Any
            if mask is not None and isinstance(metric, MaskedMetric):
                value = metric.measure_masked(image, target, mask)
            else:
                value = metric.measure(image, target)
        except UnavailableError:
            raise
        except SystemExit as error:  # would end gsbench without a message
            raise InputError(f"eval.extra.{key} ended the process (exit code {error.code}): it must return") from error
        except Exception as error:
            if key not in self.own:
                raise
            frame = traceback.extract_tb(error.__traceback__)[-1]
            message = " ".join(f"{type(error).__name__} {str(error)[:200]}".split())
            raise InputError(
                f"eval.extra.{key} raised {message} ({frame.filename}, line {frame.lineno}): correct it"
            ) from error
        if isinstance(value, Tensor | np.ndarray | np.generic) and math.prod(value.shape) == 1:
            value = value.item()
        if isinstance(value, bool) or not isinstance(value, Real):
            raise InputError(f"eval.extra.{key} must return a number for each view, got {value!r:.80}")
        try:
            return float(value)
        except OverflowError:
            raise InputError(
                f"eval.extra.{key} must return a number for each view, got one beyond all bounds"
            ) from None

    def _leave_out(self, key: str, error: UnavailableError) -> None:
        self.unavailable[key] = " ".join(str(error).split())
        if error.awaited and key not in self.own:
            self.awaited.add(key)

    def _prepare(self, image: NDArray[Any] | Tensor) -> Tensor:
        tensor = torch.as_tensor(image, device=self.device)  # [H, W, 3]
        if tensor.dtype != torch.uint8:
            if not bool(tensor.isfinite().all()):
                raise TrainingError("a render holds values that are not finite: the trained model is broken")
            tensor = quantize(tensor)
        return as_unit_range(tensor, torch.float32)


def _load(facts: MetricFacts, context: MetricContext) -> Metric:
    """Make one of gsbench's own metrics; raises UnavailableError if its weights or packages are missing."""
    module, _, name = facts.target.rpartition(".")
    metric: Metric = getattr(importlib.import_module(module), name)(context, **facts.options)
    return metric


def quantize(image: Tensor) -> Tensor:
    """Round a floating point image in [0, 1] to uint8, as for a PNG: ``floor(clamp(255 x + 0.5, 0, 255))``."""
    return (image * 255 + 0.5).clamp(0, 255).to(torch.uint8)


def summarize(per_view: Mapping[str, Mapping[str, float]], unavailable: Mapping[str, str]) -> dict[str, float]:
    """The mean over views of every metric that all views have and that is not in ``unavailable``."""
    if not per_view:
        return {}
    views = list(per_view.values())
    shared = [key for key in views[0] if key not in unavailable and all(key in view for view in views)]
    return {key: float(np.mean([view[key] for view in views])) for key in shared}
