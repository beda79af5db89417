"""Named, versioned sets of evaluation conventions. Loads no torch.

Every result holds an identifier such as ``paper-1``, and results of two protocols never share a
table cell. A change of any convention below needs a new version.
"""

from dataclasses import dataclass
from typing import Literal

from gsbench.errors import InputError

SsimPadding = Literal["zero", "valid"]

# Pixels per degree of a 0.7 m wide display of 3840 px, seen from 0.7 m: the default viewer of
# Andersson et al. 2020.
FLIP_PPD = 67.02


@dataclass(frozen=True)
class Protocol:
    """The conventions under which metrics are computed.

    All protocols round renders to 8 bits before the comparison, as a PNG stores them
    (``floor(clamp(255 x + 0.5))``), and average per-view values with a plain mean. ``ssim_padding``
    is explained in ``gsbench.eval.ssim.ssim``. ``lpips`` is the variant that tables show as the
    LPIPS of this protocol. ``flip_ppd`` are the pixels per degree of FLIP's viewer. ``psnr_cap``
    (dB) replaces higher values, such as the infinite PSNR of identical images, which JSON cannot
    hold.
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


# The paper evaluates with the 3DGS repository, whose metrics read PNGs, pad SSIM with zeros and
# feed VGG with [0, 1].
PAPER = Protocol("paper", 1, ssim_padding="zero", lpips="vgg_raw")
# The definitions of the metrics' authors: SSIM inside the image only, LPIPS on [-1, 1].
STANDARD = Protocol("standard", 1, ssim_padding="valid", lpips="vgg")
PROTOCOLS = {protocol.name: protocol for protocol in (PAPER, STANDARD)}


def get_protocol(name: str) -> Protocol:
    """The protocol ``name``; raises ``InputError`` naming the known protocols."""
    if name not in PROTOCOLS:
        raise InputError(
            f"unknown evaluation protocol {name!r}; choose one of {', '.join(PROTOCOLS)}"
        )
    return PROTOCOLS[name]


def protocol_of(identifier: str) -> Protocol | None:
    """The protocol of an identifier such as ``paper-1``, of any version; None if unknown."""
    return PROTOCOLS.get(identifier.rpartition("-")[0])
