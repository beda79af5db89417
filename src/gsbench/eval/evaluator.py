"""The evaluator: it applies a protocol's metrics and the user's own to pairs of images."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
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
from gsbench.eval.facts import (
    LPIPS,
    METRICS,
    MORE,
    facts_of,
    further_keys,
    lpips_variants,
)
from gsbench.eval.flip import flip, flip_map
from gsbench.eval.images import (
    as_batch,
    as_unit_range,
    check_pair,
    in_double_precision,
    replace_ignored,
)
from gsbench.eval.lpips import Lpips, load_lpips
from gsbench.eval.metric import (
    MaskedMetric,
    Measure,
    Metric,
    UnavailableError,
    require_size,
)
from gsbench.eval.more import STRUCTURAL, load_structural
from gsbench.eval.protocol import Protocol
from gsbench.eval.regions import LEAST_SHARE, Regions
from gsbench.eval.ssim import ssim
from gsbench.runs.experiments import AT
from gsbench.weights import MissingWeightsError
from gsbench.words import raised


def psnr(image: Tensor, target: Tensor) -> Tensor:
    """Peak signal-to-noise ratio in dB, of the mean squared error over pixels and channels.

    Images are in [0, 1]: [H, W, 3] (the value is a 0-dimensional tensor), or a batch [B, 3, H, W]
    (the values are [B]). Identical images give infinity, which a protocol replaces in reports.
    """
    check_pair(image, target)
    squared = (image - target).square()
    mse = squared.mean() if image.ndim == 3 else squared.flatten(1).mean(dim=1)  # [] or [B]
    return -10.0 * mse.log10()


def measure_psnr(protocol: Protocol) -> Measure:
    """Peak signal-to-noise ratio in dB, at most the protocol's cap.

    The cap also replaces the infinite PSNR of identical images.
    """

    def measure(image: Tensor, truth: Tensor, mask: Tensor | None) -> float:
        if mask is not None:
            image, truth = image[mask][None], truth[mask][None]
        value = float(psnr(in_double_precision(image), in_double_precision(truth)))
        return min(value, protocol.psnr_cap)

    return measure


def measure_gsbench(key: str, evaluator: Evaluator) -> Measure:
    """gsbench's metric ``key``; raises UnavailableError if weights or a package are missing."""
    protocol = evaluator.protocol
    match key:
        case "psnr":
            return measure_psnr(protocol)
        case "ssim":
            return lambda image, truth, mask: float(
                ssim(
                    in_double_precision(image),
                    in_double_precision(truth),
                    protocol.ssim_padding,
                    mask,
                )
            )
        case "flip":
            return partial(_flip, protocol.flip_ppd)
    if key.startswith(LPIPS):
        net, _, raw = key.removeprefix(LPIPS).partition("_")
        return partial(_lpips, evaluator.network(net), bool(raw))
    return load_structural(key)


def _flip(ppd: float, image: Tensor, truth: Tensor, mask: Tensor | None) -> float:
    if mask is None:
        return float(flip(image, truth, ppd))
    return float(in_double_precision(flip_map(image, truth, ppd))[mask].mean())


def _lpips(network: Lpips, raw: bool, image: Tensor, truth: Tensor, mask: Tensor | None) -> float:
    """LPIPS by one network, fed [-1, 1] as it is defined, or [0, 1] if ``raw``."""
    require_size(image, network.backbone.min_size)
    first, second = as_batch(image), as_batch(truth)  # [1, 3, H, W] each
    if not raw:
        first, second = 2 * first - 1, 2 * second - 1
    return float(network(first, second, mask))


def measure_own(name: str, metric: Metric) -> Measure:
    """A user's metric, which may not know masks. It raises InputError for what it does wrong."""

    def measure(image: Tensor, truth: Tensor, mask: Tensor | None) -> float:
        value: Any
        try:
            if mask is not None and isinstance(metric, MaskedMetric):
                value = metric.measure_masked(image, truth, mask)
            else:
                value = metric.measure(image, truth)
        except UnavailableError:
            raise
        except SystemExit as error:  # would end gsbench without a message
            raise InputError(
                f"eval.extra.{name} ended the process (exit code {error.code}): it must return"
            ) from error
        except Exception as error:
            raise InputError(f"eval.extra.{name} raised {raised(error)}: correct it") from error
        if isinstance(value, Tensor | np.ndarray | np.generic) and math.prod(value.shape) == 1:
            value = value.item()
        must = f"eval.extra.{name} must return a number for each view, got"
        if isinstance(value, bool) or not isinstance(value, Real):
            raise InputError(f"{must} {value!r:.80}")
        try:
            return float(value)
        except OverflowError:
            raise InputError(f"{must} one that is too large") from None

    return measure


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
        self.extra, self.more = dict(extra), tuple(sorted(more))
        self.device = torch.device(device)
        self.unavailable: dict[str, str] = {}
        self.awaited: set[str] = set()
        self.own = {name: facts_of(name, metric) for name, metric in extra.items()}
        wanted = {f"{LPIPS}{variant}" for variant in (variants if lpips is None else lpips)}
        wanted |= {facts.key for facts in METRICS if not facts.setting}
        wanted |= {*more, *(["flip"] if flip else [])}
        self._lpips = weights, download
        self._networks: dict[str, Lpips | MissingWeightsError] = {}  # each looked for once
        self._metrics: dict[str, Measure] = {}
        for facts in METRICS:
            if facts.key in wanted:
                try:
                    self._metrics[facts.key] = measure_gsbench(facts.key, self)
                except UnavailableError as error:
                    self._leave_out(facts.key, error)
            # Further metrics are not listed as unavailable: that list is in the keys of results,
            # which a new metric must not change.
            elif facts.setting != MORE:
                self.unavailable[facts.key] = f"not asked for ({facts.setting})"
        self._metrics |= {name: measure_own(name, metric) for name, metric in extra.items()}
        self._in_regions = [
            key
            for key in self._metrics
            if (isinstance(extra[key], MaskedMetric) if key in extra else key not in STRUCTURAL)
            and not key.startswith(LPIPS)
        ]

    def network(self, net: str) -> Lpips:
        """The LPIPS network ``net``; raises UnavailableError if its weights are missing."""
        if net not in self._networks:
            try:
                self._networks[net] = load_lpips(net, *self._lpips, self.device)
            except MissingWeightsError as error:
                self._networks[net] = error
        network = self._networks[net]
        if isinstance(network, MissingWeightsError):
            raise UnavailableError(str(network), awaited=True)
        return network

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
        values, places = {}, [(key, counted) for key in self._metrics]
        for name, pixels in regions.items():
            inside = torch.as_tensor(pixels, device=self.device)  # [H, W]
            inside = inside if counted is None else inside & counted
            if float(inside.float().mean()) >= LEAST_SHARE:
                places += [(f"{key}{AT}{name}", inside) for key in self._in_regions]
        for key, within in places:
            if is_left_out(key, self.unavailable):
                continue
            try:
                value = self._metrics[key.partition(AT)[0]](image, target, within)
                if not math.isfinite(value):
                    raise UnavailableError(f"the value of a view is {value}")
                values[key] = value
            except UnavailableError as error:
                self._leave_out(key, error)
        return values

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
