"""Named, versioned sets of evaluation conventions. Loads no torch.

Two protocols never share a table cell: an identifier such as ``paper-1`` goes into every result, and a change of any
convention below needs a new version.
"""

from dataclasses import dataclass
from typing import Literal

from gsbench.errors import InputError

SsimPadding = Literal["zero", "valid"]

# Pixels per degree of a 0.7 m wide, 3840 px display seen from 0.7 m: the default viewer of Andersson et al. 2020.
FLIP_PPD = 67.02


@dataclass(frozen=True)
class Protocol:
    """The conventions under which metrics are computed; means over views are plain means of the per-view values.

    In all of them renders are rounded to 8 bits (``floor(clamp(255 x + 0.5))``) before they are compared, as a PNG
    would store them. ``ssim_padding``: see ``gsbench.eval.ssim.ssim``. ``lpips``: the variant that tables show as
    *the* LPIPS of this protocol. ``flip_ppd``: pixels per degree of FLIP's viewer. ``psnr_cap``: dB, reported for pairs
    of higher PSNR; identical images, whose PSNR is infinite and has no number in JSON, get it.
    """

    name: str
    version: int
    ssim_padding: SsimPadding
    lpips: str
    flip_ppd: float = FLIP_PPD
    psnr_cap: float = 100.0

    @property
    def id(self) -> str:
        return f"{self.name}-{self.version}"


# The paper evaluates with the 3DGS repository, whose metrics read PNGs, pad SSIM with zeros and feed VGG with [0, 1].
PAPER = Protocol("paper", 1, ssim_padding="zero", lpips="vgg_raw")
# The definitions of the metrics' authors: SSIM inside the image only, LPIPS on [-1, 1].
STANDARD = Protocol("standard", 1, ssim_padding="valid", lpips="vgg")
PROTOCOLS = {protocol.name: protocol for protocol in (PAPER, STANDARD)}


def get_protocol(name: str) -> Protocol:
    """The protocol of that name; raises ``InputError`` naming the known ones."""
    if name not in PROTOCOLS:
        raise InputError(f"unknown evaluation protocol {name!r}; choose one of {', '.join(PROTOCOLS)}")
    return PROTOCOLS[name]


def protocol_of(identifier: str) -> Protocol | None:
    """The protocol with an identifier such as ``paper-1``, whatever its version; None for an unknown one."""
    return PROTOCOLS.get(identifier.rpartition("-")[0])
