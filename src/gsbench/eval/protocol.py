"""Named, versioned sets of evaluation conventions. Loads no torch.

Two protocols never share a table cell: an identifier such as ``paper-1`` goes into every result, and a change of any
convention below needs a new version.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from gsbench.errors import InputError

SsimPadding = Literal["zero", "valid", "reflect"]
Shrinking = Literal["bicubic", "lanczos"]
ColorFit = Literal["all", "left"]

# Pixels per degree of a 0.7 m wide, 3840 px display seen from 0.7 m: the default viewer of Andersson et al. 2020.
FLIP_PPD = 67.02


@dataclass(frozen=True)
class Protocol:
    """The conventions under which metrics are computed; means over views are plain means of the per-view values.

    ``eight_bit``: renders are rounded to 8 bits (``floor(clamp(255 x + 0.5))``) before they are compared, as a PNG
    would store them. ``ssim_padding``: see ``gsbench.eval.ssim.ssim``. ``lpips``: the variant that tables show as
    *the* LPIPS of this protocol. ``flip_ppd``: pixels per degree of FLIP's viewer. ``psnr_cap``: dB, reported for pairs
    of higher PSNR; identical images, whose PSNR is infinite and has no number in JSON, get it. ``color_fit``: metrics
    ``cc_…`` stand beside the others, measured after the colours of each render were fitted to its photograph
    (`gsbench.eval.images`): on ``all`` pixels, or on the ``left`` half of the picture, and then everything is
    measured on its right half.

    ``shrinking``: how photographs are made smaller, None where they are taken as they come. ``full_size``: they are
    made smaller from those of the full size even where the data set brings smaller ones. ``source``: where these facts
    were read.
    """

    name: str
    version: int
    eight_bit: bool
    ssim_padding: SsimPadding
    lpips: str | None
    flip_ppd: float = FLIP_PPD
    psnr_cap: float = 100.0
    shrinking: Shrinking | None = None
    full_size: bool = False
    source: str = ""
    color_fit: ColorFit | None = None

    @property
    def id(self) -> str:
        return f"{self.name}-{self.version}"


# The paper evaluates with the 3DGS repository, whose metrics read PNGs, pad SSIM with zeros and feed VGG with [0, 1].
PAPER = Protocol("paper", 1, eight_bit=True, ssim_padding="zero", lpips="vgg_raw")
# The definitions of the metrics' authors: SSIM inside the image only, LPIPS on [-1, 1].
STANDARD = Protocol("standard", 1, eight_bit=True, ssim_padding="valid", lpips="vgg")
# Those of `STANDARD`, with metrics after a fit of colours beside the raw ones. Fitted on all pixels as gsplat does it;
# on one half and measured on the other as NeRF in the Wild (Martin-Brualla et al. 2021, section 4.1) does it.
AFFINE = replace(STANDARD, name="affine", color_fit="all")
AFFINE_HALF = replace(STANDARD, name="affine_half", color_fit="left")
PROTOCOLS = {protocol.name: protocol for protocol in (PAPER, STANDARD, AFFINE, AFFINE_HALF)}


# Conventions of others, for renders that are there: a trial is measured by one of the above. All five have SSIM's
# window of 11 px with sigma 1.5 and crop nothing. Most take smaller photographs as a data set brings them, and shrink
# others.
OTHERS = {
    protocol.name: protocol
    for protocol in (
        Protocol(
            "3dgs", 1, eight_bit=True, ssim_padding="zero", lpips="vgg_raw", shrinking="bicubic",
            source="graphdeco-inria/gaussian-splatting 15d64e6 (metrics.py, utils/loss_utils.py, "
            "utils/general_utils.py), 1152adc (render.py)",
        ),
        Protocol(
            "gsplat", 2, eight_bit=False, ssim_padding="reflect", lpips="alex", shrinking="bicubic", full_size=True,
            source="nerfstudio-project/gsplat 90d7b4b (examples/simple_trainer.py, examples/datasets/colmap.py), "
            "torchmetrics 1.8.2 (functional/image/ssim.py)",
        ),
        Protocol(
            "nerfbaselines", 1, eight_bit=True, ssim_padding="valid", lpips="alex", shrinking="bicubic",
            source="nerfbaselines/nerfbaselines cde53bd (evaluation.py, metrics.py, datasets/_common.py)",
        ),
        Protocol(
            "nerfstudio", 1, eight_bit=False, ssim_padding="valid", lpips="alex", shrinking="bicubic",
            source="nerfstudio-project/nerfstudio 50e0e3c (models/splatfacto.py, "
            "data/dataparsers/colmap_dataparser.py)",
        ),
        Protocol(
            "mipnerf360", 1, eight_bit=True, ssim_padding="valid", lpips=None, shrinking="lanczos",
            source="google-research/multinerf 5b4d4f6 (eval.py, internal/image.py, scripts/local_colmap_and_resize.sh)",
        ),
    )
}  # fmt: skip
ALL = PROTOCOLS | OTHERS


def get_protocol(name: str) -> Protocol:
    """The protocol of that name, one of a trial's or of `OTHERS`; raises ``InputError`` naming the known ones."""
    if name not in ALL:
        raise InputError(f"unknown evaluation protocol {name!r}; choose one of {', '.join(ALL)}")
    return ALL[name]


def protocol_of(identifier: str) -> Protocol | None:
    """The protocol with an identifier such as ``paper-1``, whatever its version; None for an unknown one."""
    return ALL.get(identifier.rpartition("-")[0])
