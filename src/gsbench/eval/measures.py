"""gsbench's own metrics as the evaluator calls them, each under the conventions of a protocol."""

import importlib.util
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from gsbench.eval import fsim, metrics, multiscale
from gsbench.eval.images import exact
from gsbench.eval.lpips import Lpips, load_lpips
from gsbench.eval.metric import UnavailableError
from gsbench.eval.metrics import flip, flip_map, psnr
from gsbench.eval.protocol import Protocol
from gsbench.eval.ssim import masked_ssim, ssim
from gsbench.weights import MissingWeights


@dataclass(frozen=True)
class Conditions:
    """Conditions that gsbench's metrics share; ``weights`` is a folder to look in first."""

    protocol: Protocol
    device: torch.device
    weights: Path | None = None
    download: bool = True
    networks: dict[str, Lpips | MissingWeights] = field(default_factory=dict, repr=False)  # of LPIPS, each loaded once

    def network(self, net: str) -> Lpips:
        """The LPIPS network ``net``; raises UnavailableError where its weights are not to be had."""
        if net not in self.networks:
            try:
                self.networks[net] = load_lpips(net, self.weights, self.download, self.device)
            except MissingWeights as error:
                self.networks[net] = error
        found = self.networks[net]
        if isinstance(found, MissingWeights):
            raise UnavailableError(str(found), awaited=True)
        return found


class Psnr:
    """Peak signal-to-noise ratio, dB; at most the protocol's cap, which identical images get."""

    def __init__(self, conditions: Conditions) -> None:
        self._cap = conditions.protocol.psnr_cap

    def measure(self, image: Tensor, truth: Tensor) -> float:
        return min(float(psnr(exact(image), exact(truth))), self._cap)

    def measure_masked(self, image: Tensor, truth: Tensor, mask: Tensor) -> float:
        return self.measure(image[mask][None], truth[mask][None])


class Ssim:
    """Structural similarity with the protocol's padding."""

    def __init__(self, conditions: Conditions) -> None:
        self._padding = conditions.protocol.ssim_padding

    def measure(self, image: Tensor, truth: Tensor) -> float:
        return float(ssim(exact(image), exact(truth), self._padding))

    def measure_masked(self, image: Tensor, truth: Tensor, mask: Tensor) -> float:
        return float(masked_ssim(exact(image), exact(truth), mask, self._padding))


class LpipsMetric:
    """LPIPS by one network, fed [-1, 1] as it is defined or, ``raw``, [0, 1]."""

    def __init__(self, conditions: Conditions, net: str, raw: bool) -> None:
        self._network, self._raw = conditions.network(net), raw

    def measure(self, image: Tensor, truth: Tensor) -> float:
        return self._distance(image, truth)

    def measure_masked(self, image: Tensor, truth: Tensor, mask: Tensor) -> float:
        return self._distance(image, truth, mask)

    def _distance(self, image: Tensor, truth: Tensor, mask: Tensor | None = None) -> float:
        _need_size(image, self._network.backbone.min_size)
        first, second = (x.permute(2, 0, 1).unsqueeze(0) for x in (image, truth))  # [1, 3, H, W] each
        if not self._raw:
            first, second = 2 * first - 1, 2 * second - 1
        return float(self._network(first, second, mask))


class Flip:
    """FLIP for the protocol's viewer."""

    def __init__(self, conditions: Conditions) -> None:
        if importlib.util.find_spec("flip_evaluator") is None:
            reason = "the package flip-evaluator is not installed: pip install flip-evaluator"
            raise UnavailableError(reason, awaited=True)
        self._ppd = conditions.protocol.flip_ppd

    def measure(self, image: Tensor, truth: Tensor) -> float:
        return float(flip(image, truth, self._ppd))

    def measure_masked(self, image: Tensor, truth: Tensor, mask: Tensor) -> float:
        return float(flip_map(image, truth, self._ppd)[mask].mean())


class Structural:
    """A metric without weights that looks at structure; of each, its function of two images and its smallest side."""

    function: Callable[[Tensor, Tensor], Tensor]
    smallest: int  # px

    def __init__(self, conditions: Conditions) -> None:
        pass  # no protocol says anything of these: their authors' definitions hold

    def measure(self, image: Tensor, truth: Tensor) -> float:
        _need_size(image, self.smallest)
        value = float(type(self).function(exact(image), exact(truth)))
        if not math.isfinite(value):
            raise UnavailableError("a view is flat: it has no structure to compare")
        return value


class MsSsim(Structural):
    function, smallest = staticmethod(multiscale.ms_ssim), multiscale.MIN_SIZE


class IwSsim(Structural):
    function, smallest = staticmethod(multiscale.iw_ssim), multiscale.MIN_SIZE


class Fsim(Structural):
    function, smallest = staticmethod(fsim.fsim), fsim.MIN_SIZE


class Gmsd(Structural):
    function, smallest = staticmethod(metrics.gmsd), metrics.GMSD_MIN_SIZE


def _need_size(image: Tensor, smallest: int) -> None:
    """Raise UnavailableError for a view [H, W, 3] with a side below ``smallest`` px."""
    height, width = image.shape[:2]
    if min(height, width) < smallest:
        raise UnavailableError(f"a view is {width}x{height} px, below {smallest} px a side")
