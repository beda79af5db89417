"""The evaluator: it applies a protocol's metrics and the user's own to pairs of images."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from numbers import Real
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsbench.errors import InputError, TrainingError
from gsbench.eval.color_correction import Corrected
from gsbench.eval.facts import (
    CORRECTED,
    LPIPS,
    METRICS,
    MORE,
    facts_of,
    further_keys,
    lpips_variants,
)
from gsbench.eval.flip import flip, flip_map
from gsbench.eval.images import as_batch, as_unit_range, in_double_precision, replace_ignored
from gsbench.eval.lpips import Lpips, load_lpips
from gsbench.eval.metric import MaskedMetric, Metric, UnavailableError
from gsbench.eval.metrics import psnr
from gsbench.eval.protocol import Protocol
from gsbench.eval.regions import LEAST_SHARE, Regions
from gsbench.eval.ssim import ssim
from gsbench.eval.structure import STRUCTURAL, load_structural
from gsbench.runs.experiments import AT
from gsbench.weights import MissingWeightsError
from gsbench.words import raised


@dataclass(frozen=True)
class MetricContext:
    """Conditions that gsbench's metrics share; ``weights`` is the folder that is searched first."""

    protocol: Protocol
    device: torch.device
    weights: Path | None = None
    download: bool = True
    # LPIPS networks, each loaded once, or the error for missing weights
    networks: dict[str, Lpips | MissingWeightsError] = field(default_factory=dict, repr=False)

    def network(self, net: str) -> Lpips:
        """The LPIPS network ``net``; raises UnavailableError if its weights are missing."""
        if net not in self.networks:
            try:
                self.networks[net] = load_lpips(net, self.weights, self.download, self.device)
            except MissingWeightsError as error:
                self.networks[net] = error
        network = self.networks[net]
        if isinstance(network, MissingWeightsError):
            raise UnavailableError(str(network), awaited=True)
        return network


class Psnr:
    """Peak signal-to-noise ratio in dB, at most the protocol's cap.

    The cap also replaces the infinite PSNR of identical images.
    """

    def __init__(self, context: MetricContext) -> None:
        self._cap = context.protocol.psnr_cap

    def measure(self, image: Tensor, truth: Tensor) -> float:
        return min(float(psnr(in_double_precision(image), in_double_precision(truth))), self._cap)

    def measure_masked(self, image: Tensor, truth: Tensor, mask: Tensor) -> float:
        return self.measure(image[mask][None], truth[mask][None])


class Ssim:
    """Structural similarity with the protocol's padding."""

    def __init__(self, context: MetricContext) -> None:
        self._padding = context.protocol.ssim_padding

    def measure(self, image: Tensor, truth: Tensor, mask: Tensor | None = None) -> float:
        return float(
            ssim(in_double_precision(image), in_double_precision(truth), self._padding, mask)
        )

    measure_masked = measure


class LpipsMetric:
    """LPIPS by one network, fed [-1, 1] as it is defined, or [0, 1] if ``raw``."""

    def __init__(self, context: MetricContext, net: str, raw: bool = False) -> None:
        self._network, self._raw = context.network(net), raw

    def measure(self, image: Tensor, truth: Tensor, mask: Tensor | None = None) -> float:
        _require_size(image, self._network.backbone.min_size)
        first, second = as_batch(image), as_batch(truth)  # [1, 3, H, W] each
        if not self._raw:
            first, second = 2 * first - 1, 2 * second - 1
        return float(self._network(first, second, mask))

    measure_masked = measure


class Flip:
    """FLIP for the protocol's viewer."""

    def __init__(self, context: MetricContext) -> None:
        self._ppd = context.protocol.flip_ppd

    def measure(self, image: Tensor, truth: Tensor) -> float:
        return float(flip(image, truth, self._ppd))

    def measure_masked(self, image: Tensor, truth: Tensor, mask: Tensor) -> float:
        return float(in_double_precision(flip_map(image, truth, self._ppd))[mask].mean())


class StructuralMetric:
    """A structural metric by its authors' definition, which is the same in all protocols."""

    def __init__(self, context: MetricContext, key: str) -> None:
        self._measure, self._min_side = load_structural(key), STRUCTURAL[key].min_side  # px

    def measure(self, image: Tensor, truth: Tensor) -> float:
        _require_size(image, self._min_side)
        return self._measure(in_double_precision(image), in_double_precision(truth))


def _require_size(image: Tensor, min_side: int) -> None:
    """Raise UnavailableError for a view [H, W, 3] with a side below ``min_side`` px."""
    height, width = image.shape[:2]
    if min(height, width) < min_side:
        raise UnavailableError(f"a view is {width}x{height} px, below {min_side} px a side")


def _corrected(key: str) -> Callable[[MetricContext], Metric]:
    """The metric ``key`` after a correction of the colours."""
    return lambda context: Corrected(MEASURES[key](context))


# Makes each metric of `gsbench.eval.facts.METRICS` for a context, or raises UnavailableError if
# weights are missing.
MEASURES: dict[str, Callable[[MetricContext], Metric]] = {
    "psnr": Psnr,
    "ssim": Ssim,
    "lpips_vgg_raw": partial(LpipsMetric, net="vgg", raw=True),
    "lpips_vgg": partial(LpipsMetric, net="vgg"),
    "lpips_alex": partial(LpipsMetric, net="alex"),
    "lpips_squeeze": partial(LpipsMetric, net="squeeze"),
    "flip": Flip,
}
MEASURES |= {key: partial(StructuralMetric, key=key) for key in STRUCTURAL}
MEASURES |= {
    f"{key}{CORRECTED}": _corrected(key)
    for key in list(MEASURES)
    if f"{key}{CORRECTED}" in further_keys()
}
MEASURES["cc_gain"] = lambda context: Corrected(Psnr(context), gain=True)


class Evaluator:
    """Computes the metrics of one protocol; loads every network once.

    ``lpips`` names the variants to compute (see `gsbench.eval.facts.lpips_variants`), ``more``
    names further metrics of gsbench (`further_keys`), and ``extra`` are the user's own metrics by
    name. ``weights`` is the folder that is searched first.

    ``unavailable`` maps each metric that cannot be computed to the reason, in one line. ``awaited``
    holds those that can be computed once their weights are installed. Both can grow
    while views are evaluated; ``summarize`` then leaves the metric out for all views. ``own`` are
    the facts of the user's metrics.
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
        for what, given, known in (
            ("LPIPS variant", lpips or (), variants),
            ("metric", more, further_keys()),
        ):
            if unknown := [key for key in given if key not in known]:
                raise InputError(f"unknown {what} {unknown[0]!r}; choose among {', '.join(known)}")
        self.protocol = protocol
        self.device = torch.device(device)
        self.unavailable: dict[str, str] = {}
        self.awaited: set[str] = set()
        self.extra = dict(extra)
        self.more = tuple(sorted(more))
        self.own = {name: facts_of(name, metric) for name, metric in extra.items()}
        wanted = {f"{LPIPS}{variant}" for variant in (variants if lpips is None else lpips)}
        wanted |= {facts.key for facts in METRICS if not facts.setting}
        wanted |= {*more, *(["flip"] if flip else [])}
        context = MetricContext(protocol, self.device, weights, download)
        self._metrics: dict[str, Metric] = {}
        for facts in METRICS:
            if facts.setting == MORE and facts.key not in wanted:
                # not listed as unavailable: that list is in the keys of results, which a new metric
                # must not change
                continue
            try:
                if facts.key not in wanted:
                    raise UnavailableError(f"not asked for ({facts.setting})")
                self._metrics[facts.key] = MEASURES[facts.key](context)
            except UnavailableError as error:
                self._leave_out(facts.key, error)
        self._metrics |= extra

    def evaluate_view(
        self,
        render: NDArray[Any] | Tensor,
        ground_truth: NDArray[Any] | Tensor,
        mask: NDArray[np.bool_] | None = None,
        regions: Regions = MappingProxyType({}),
    ) -> dict[str, float]:
        """The metrics of one view; images are [H, W, 3], uint8 or floating point in [0, 1].

        Where ``mask`` [H, W] is False, the render is ignored: its pixels are replaced by the
        photograph's before anything is measured, and metrics that average over pixels leave them
        out (see `MaskedMetric`).

        Metrics that can leave out pixels are also measured in each of ``regions`` (masks [H, W])
        that has at least 1 % of the view, as ``psnr@far``. LPIPS is not: its features reach far
        beyond a region.

        A metric that cannot be computed is absent and listed in ``unavailable``. Raises
        ``TrainingError`` if the render holds a non-finite value.
        """
        image, target = self._prepare(render), self._prepare(ground_truth)  # [H, W, 3]
        counted = None if mask is None else torch.as_tensor(mask, device=self.device)  # [H, W]
        image = replace_ignored(image, target, None if counted is None else counted[..., None])
        values = {}
        measures: list[tuple[str, Metric, Tensor | None]]
        measures = [(key, metric, counted) for key, metric in self._metrics.items()]
        for name, pixels in regions.items():
            inside = torch.as_tensor(pixels, device=self.device)  # [H, W]
            inside = inside if counted is None else inside & counted
            if float(inside.float().mean()) >= LEAST_SHARE:
                measures += [
                    (f"{key}{AT}{name}", metric, inside)
                    for key, metric in self._metrics.items()
                    if isinstance(metric, MaskedMetric) and not key.startswith(LPIPS)
                ]
        for key, metric, within in measures:
            if is_left_out(key, self.unavailable):
                continue
            try:
                value = self._measure(key.partition(AT)[0], metric, image, target, within)
                if not math.isfinite(value):
                    raise UnavailableError(f"the value of a view is {value}")
                values[key] = value
            except UnavailableError as error:
                self._leave_out(key, error)
        return values

    def _measure(
        self, key: str, metric: Metric, image: Tensor, target: Tensor, mask: Tensor | None
    ) -> float:
        try:
            value: Any
            if mask is not None and isinstance(metric, MaskedMetric):
                value = metric.measure_masked(image, target, mask)
            else:
                value = metric.measure(image, target)
        except UnavailableError:
            raise
        except SystemExit as error:  # would end gsbench without a message
            raise InputError(
                f"eval.extra.{key} ended the process (exit code {error.code}): it must return"
            ) from error
        except Exception as error:
            if key not in self.own:
                raise
            raise InputError(f"eval.extra.{key} raised {raised(error)}: correct it") from error
        if isinstance(value, Tensor | np.ndarray | np.generic) and math.prod(value.shape) == 1:
            value = value.item()
        if isinstance(value, bool) or not isinstance(value, Real):
            raise InputError(
                f"eval.extra.{key} must return a number for each view, got {value!r:.80}"
            )
        try:
            return float(value)
        except OverflowError:
            raise InputError(
                f"eval.extra.{key} must return a number for each view, got one that is too large"
            ) from None

    def _leave_out(self, key: str, error: UnavailableError) -> None:
        self.unavailable[key] = " ".join(str(error).split())
        if error.awaited and key not in self.own:
            self.awaited.add(key)

    def _prepare(self, image: NDArray[Any] | Tensor) -> Tensor:
        tensor = torch.as_tensor(image, device=self.device)  # [H, W, 3]
        if tensor.dtype != torch.uint8:
            if not bool(tensor.isfinite().all()):
                raise TrainingError(
                    "a render holds values that are not finite: the trained model is broken"
                )
            tensor = quantize(tensor)
        return as_unit_range(tensor, torch.float32)


def quantize(image: Tensor) -> Tensor:
    """Round a float image in [0, 1] to uint8 as in a PNG: ``floor(clamp(255 x + 0.5, 0, 255))``."""
    return (image * 255 + 0.5).clamp(0, 255).to(torch.uint8)


def summarize(
    per_view: Mapping[str, Mapping[str, float]], unavailable: Mapping[str, str]
) -> dict[str, float]:
    """The mean over views of every metric that all views have, without ``unavailable``.

    A metric of a region has the mean over the views that show the region.
    """
    views = list(per_view.values())
    keys = dict.fromkeys(key for view in views for key in view)
    shared = [key for key in keys if AT in key or all(key in view for view in views)]
    return {
        key: float(np.mean([view[key] for view in views if key in view]))
        for key in shared
        if not is_left_out(key, unavailable)
    }


def is_left_out(key: str, unavailable: Mapping[str, str]) -> bool:
    """Return whether a metric is ``unavailable``, by itself or as the metric of a region."""
    return key in unavailable or key.partition(AT)[0] in unavailable
