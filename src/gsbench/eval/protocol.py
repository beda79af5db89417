"""Named, versioned sets of evaluation conventions, and the evaluator that applies one to pairs of images.

Two protocols never share a table cell: an identifier such as ``paper-1`` goes into every result, and a change of any
convention below needs a new version.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsbench.errors import InputError, TrainingError
from gsbench.eval.lpips import BACKBONES, Lpips, load_lpips
from gsbench.eval.metrics import FLIP_PPD, SsimPadding, flip, psnr, ssim
from gsbench.weights import MissingWeights

# Variants of LPIPS: the network, and whether it is fed [0, 1] as it is ("raw") instead of the defined [-1, 1].
LPIPS_VARIANTS: dict[str, tuple[str, bool]] = {
    "vgg_raw": ("vgg", True),
    "vgg": ("vgg", False),
    "alex": ("alex", False),
    "squeeze": ("squeeze", False),
}


@dataclass(frozen=True)
class Protocol:
    """The conventions under which metrics are computed; means over views are plain means of the per-view values.

    ``eight_bit``: renders are rounded to 8 bits (``floor(clamp(255 x + 0.5))``) before they are compared, as a PNG
    would store them. ``ssim_padding``: see ``gsbench.eval.metrics.ssim``. ``lpips``: the variant that tables show as
    *the* LPIPS of this protocol. ``flip_ppd``: pixels per degree of FLIP's viewer. ``psnr_cap``: dB, reported for pairs
    of higher PSNR; identical images, whose PSNR is infinite and has no number in JSON, get it.
    """

    name: str
    version: int
    eight_bit: bool
    ssim_padding: SsimPadding
    lpips: str
    flip_ppd: float = FLIP_PPD
    psnr_cap: float = 100.0

    @property
    def id(self) -> str:
        return f"{self.name}-{self.version}"


# The paper evaluates with the 3DGS repository, whose metrics read PNGs, pad SSIM with zeros and feed VGG with [0, 1].
PAPER = Protocol("paper", 1, eight_bit=True, ssim_padding="zero", lpips="vgg_raw")
# The definitions of the metrics' authors: SSIM inside the image only, LPIPS on [-1, 1].
STANDARD = Protocol("standard", 1, eight_bit=True, ssim_padding="valid", lpips="vgg")
PROTOCOLS = {protocol.name: protocol for protocol in (PAPER, STANDARD)}


def get_protocol(name: str) -> Protocol:
    """The protocol of that name; raises ``InputError`` naming the known ones."""
    if name not in PROTOCOLS:
        raise InputError(f"unknown evaluation protocol {name!r}; choose one of {', '.join(PROTOCOLS)}")
    return PROTOCOLS[name]


class Evaluator:
    """Computes the metrics of one protocol; loads every network once.

    ``lpips`` names the variants to compute (keys of ``LPIPS_VARIANTS``); ``weights`` is a folder to look in first.
    ``unavailable`` maps each metric that cannot be computed to its reason in one line; it can grow while views are
    evaluated, and such a metric is then left out of ``summarize`` for every view.
    """

    def __init__(
        self,
        protocol: Protocol,
        device: torch.device | str = "cpu",
        lpips: Sequence[str] = tuple(LPIPS_VARIANTS),
        flip: bool = True,
        weights: Path | None = None,
        download: bool = True,
    ) -> None:
        unknown = [variant for variant in lpips if variant not in LPIPS_VARIANTS]
        if unknown:
            raise InputError(f"unknown LPIPS variant {unknown[0]!r}; choose among {', '.join(LPIPS_VARIANTS)}")
        self.protocol = protocol
        self.device = torch.device(device)
        self.unavailable: dict[str, str] = {}
        self._variants = tuple(variant for variant in LPIPS_VARIANTS if variant in lpips)
        self._networks: dict[str, Lpips] = {}
        for variant in LPIPS_VARIANTS:
            if variant not in lpips:
                self.unavailable[f"lpips_{variant}"] = "not asked for (eval.lpips)"
        self._load_networks(weights, download)
        if not flip:
            self.unavailable["flip"] = "not asked for (eval.flip)"

    def evaluate_view(self, render: NDArray | Tensor, ground_truth: NDArray | Tensor) -> dict[str, float]:
        """The metrics of one view; images are [H, W, 3], uint8 or floating point in [0, 1].

        A metric that cannot be computed is absent and stands in ``unavailable``. Raises ``TrainingError`` where the
        render holds a non-finite value.
        """
        image, target = self._prepare(render), self._prepare(ground_truth)  # [H, W, 3]
        # In single precision, SSIM's differences of moments are off by up to 2e-4 where an image is flat.
        exact = torch.float32 if self.device.type == "mps" else torch.float64
        values = {
            "psnr": min(float(psnr(image.to(exact), target.to(exact))), self.protocol.psnr_cap),
            "ssim": float(ssim(image.to(exact), target.to(exact), self.protocol.ssim_padding)),
        }
        values |= self._lpips(image, target)
        values |= self._flip(image, target)
        return values

    def _prepare(self, image: NDArray | Tensor) -> Tensor:
        tensor = torch.as_tensor(image, device=self.device)  # [H, W, 3]
        if tensor.dtype != torch.uint8:
            if not bool(tensor.isfinite().all()):
                raise TrainingError("a render holds values that are not finite: the trained model is broken")
            if not self.protocol.eight_bit:
                return tensor.float().clamp(0, 1)
            tensor = quantize(tensor)
        return tensor.float() / 255

    def _lpips(self, image: Tensor, target: Tensor) -> dict[str, float]:
        first, second = (x.permute(2, 0, 1).unsqueeze(0) for x in (image, target))  # [1, 3, H, W] each
        values = {}
        for variant in self._variants:
            net, raw = LPIPS_VARIANTS[variant]
            key = f"lpips_{variant}"
            if key in self.unavailable:
                continue
            smallest = BACKBONES[net].min_size
            if min(image.shape[:2]) < smallest:
                self.unavailable[key] = f"a view is {image.shape[1]}x{image.shape[0]} px, below {smallest} px a side"
                continue
            network = self._networks[net]
            values[key] = float(network(first, second) if raw else network(2 * first - 1, 2 * second - 1))
        return values

    def _flip(self, image: Tensor, target: Tensor) -> dict[str, float]:
        if "flip" in self.unavailable:
            return {}
        try:
            return {"flip": float(flip(image, target, self.protocol.flip_ppd))}
        except ModuleNotFoundError:
            self.unavailable["flip"] = "the package flip-evaluator is not installed: pip install flip-evaluator"
            return {}

    def _load_networks(self, weights: Path | None, download: bool) -> None:
        faults: dict[str, str] = {}
        for variant in self._variants:
            net, _ = LPIPS_VARIANTS[variant]
            if net not in self._networks and net not in faults:
                try:
                    self._networks[net] = load_lpips(net, weights, download, self.device)
                except MissingWeights as error:
                    faults[net] = str(error)
            if net in faults:
                self.unavailable[f"lpips_{variant}"] = faults[net]


def quantize(image: Tensor) -> Tensor:
    """Round a floating point image in [0, 1] to uint8 as it goes into a PNG: ``floor(clamp(255 x + 0.5, 0, 255))``."""
    return (image * 255 + 0.5).clamp(0, 255).to(torch.uint8)


def summarize(per_view: Mapping[str, Mapping[str, float]], unavailable: Mapping[str, str]) -> dict[str, float]:
    """Means over the views of every metric that all views have and that is not in ``unavailable``."""
    if not per_view:
        return {}
    views = list(per_view.values())
    shared = [key for key in views[0] if key not in unavailable and all(key in view for view in views)]
    return {key: float(np.mean([view[key] for view in views])) for key in shared}
