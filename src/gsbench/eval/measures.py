"""gsbench's own metrics as classes, which apply the conventions of a protocol."""

import importlib.util
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from gsbench.eval import fsim, metrics, multiscale
from gsbench.eval.images import in_double_precision
from gsbench.eval.lpips import Lpips, load_lpips
from gsbench.eval.metric import UnavailableError
from gsbench.eval.metrics import flip, flip_map, psnr
from gsbench.eval.protocol import Protocol
from gsbench.eval.ssim import masked_ssim, ssim
from gsbench.weights import MissingWeightsError


@dataclass(frozen=True)
class MetricContext:
    """Conditions that gsbench's metrics share; ``weights`` is the folder that is searched first."""

    protocol: Protocol
    device: torch.device
    weights: Path | None = None
    download: bool = True
    networks: dict[str, Lpips | MissingWeightsError] = field(
        default_factory=dict, repr=False
    )  # LPIPS, each loaded once

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
    """Peak signal-to-noise ratio in dB, at most the protocol's cap (identical images have an infinite PSNR)."""

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

    def measure(self, image: Tensor, truth: Tensor) -> float:
        return float(ssim(in_double_precision(image), in_double_precision(truth), self._padding))

    def measure_masked(self, image: Tensor, truth: Tensor, mask: Tensor) -> float:
        return float(masked_ssim(in_double_precision(image), in_double_precision(truth), mask, self._padding))


class LpipsMetric:
    """LPIPS by one network, fed [-1, 1] as it is defined, or [0, 1] if ``raw``."""

    def __init__(self, context: MetricContext, net: str, raw: bool) -> None:
        self._network, self._raw = context.network(net), raw

    def measure(self, image: Tensor, truth: Tensor) -> float:
        return self._distance(image, truth)

    def measure_masked(self, image: Tensor, truth: Tensor, mask: Tensor) -> float:
        return self._distance(image, truth, mask)

    def _distance(self, image: Tensor, truth: Tensor, mask: Tensor | None = None) -> float:
        _require_size(image, self._network.backbone.min_size)
        first, second = (x.permute(2, 0, 1).unsqueeze(0) for x in (image, truth))  # [1, 3, H, W] each
        if not self._raw:
            first, second = 2 * first - 1, 2 * second - 1
        return float(self._network(first, second, mask))


class Flip:
    """FLIP for the protocol's viewer."""

    def __init__(self, context: MetricContext) -> None:
        if importlib.util.find_spec("flip_evaluator") is None:
            reason = "the package flip-evaluator is not installed: pip install flip-evaluator"
            raise UnavailableError(reason, awaited=True)
        self._ppd = context.protocol.flip_ppd

    def measure(self, image: Tensor, truth: Tensor) -> float:
        return float(flip(image, truth, self._ppd))

    def measure_masked(self, image: Tensor, truth: Tensor, mask: Tensor) -> float:
        return float(flip_map(image, truth, self._ppd)[mask].mean())


class StructuralMetric:
    """Base of metrics of structure without weights, which no protocol changes: their authors' definitions hold."""

    function: Callable[[Tensor, Tensor], Tensor]
    min_side: int  # px

    def __init__(self, context: MetricContext) -> None:
        pass

    def measure(self, image: Tensor, truth: Tensor) -> float:
        _require_size(image, self.min_side)
        value = float(type(self).function(in_double_precision(image), in_double_precision(truth)))
        if not math.isfinite(value):
            raise UnavailableError("a view is flat: it has no structure to compare")
        return value


class MsSsim(StructuralMetric):
    function, min_side = staticmethod(multiscale.ms_ssim), multiscale.MIN_SIZE


class IwSsim(StructuralMetric):
    function, min_side = staticmethod(multiscale.iw_ssim), multiscale.MIN_SIZE


class Fsim(StructuralMetric):
    function, min_side = staticmethod(fsim.fsim), fsim.MIN_SIZE


class Gmsd(StructuralMetric):
    function, min_side = staticmethod(metrics.gmsd), metrics.GMSD_MIN_SIZE


def _require_size(image: Tensor, min_side: int) -> None:
    """Raise UnavailableError for a view [H, W, 3] with a side below ``min_side`` px."""
    height, width = image.shape[:2]
    if min(height, width) < min_side:
        raise UnavailableError(f"a view is {width}x{height} px, below {min_side} px a side")
