"""Niantic's .spz, version 3: a gzip stream of quantised Gaussians, about a tenth of the PLY.

Layout and quantisation are those of nianticlabs/spz (MIT), ``src/cc/load-spz.cc`` at 21715c3: a header, then section by
section positions, opacities, colours, scales, rotations, harmonics. Version 4 packs the same with zstd and is younger
than most viewers.
"""

from __future__ import annotations

import gzip
import logging
import math
import struct

import numpy as np
import torch
from numpy.typing import NDArray

from gsbench.gaussians.model import MAX_SH_DEGREE, Gaussians

log = logging.getLogger(__name__)

MAGIC, VERSION = 0x5053474E, 3  # "NGSP"
POSITION_BITS = 24  # signed
MAX_FRACTION_BITS = 20  # a millionth of a unit; the reference has always 12, and lets far positions wrap around
COLOR_SCALE = 0.15  # of the constant harmonic: bytes reach beyond [0, 1]
SCALE_OFFSET, SCALE_STEPS = 10.0, 16.0  # a byte of a log scale: 16 (s + 10)
SH_STEPS = 128.0
SH_BUCKETS = (8,) * 3 + (16,) * 12  # of harmonics of degree 1, and above: the reference's 5 and 4 bits
FAR_SHARE = 1e-3  # of the Gaussians; so few may be blamed for a coarse step; our choice
COARSE = 0.1  # of a Gaussian's usual size, a step that can be seen; our choice
ROTATION_BITS = 9  # and a sign, of the three smaller components
# The files have y up and z backward where PLY files have y down and z forward: signs of (x, y, z), of a quaternion's
# (x, y, z), and of the 15 harmonics above the constant one, each odd in y and z together or not.
AXES = (1.0, -1.0, -1.0)
HARMONICS = (-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1)


def spz_bytes(gaussians: Gaussians) -> bytes:
    """The file's content; positions beyond 2^23 units are moved there.

    One position decides the step of all: a warning says so where a few far Gaussians make it coarse for the rest.
    """
    raw = gaussians.detach().map(lambda tensor: tensor.float().cpu())
    axes = np.array(AXES)
    means = raw.means.double().numpy() * axes  # [N, 3]
    reach = np.abs(means).max(axis=1)  # [N] units
    fraction_bits = fraction_bits_for(float(reach.max()))
    warn_of_far_points(reach, float(np.exp(np.median(raw.log_scales.double().numpy()))), fraction_bits)
    header = struct.pack("<IIIBBBB", MAGIC, VERSION, len(raw), MAX_SH_DEGREE, fraction_bits, 0, 0)
    limit = 1 << (POSITION_BITS - 1)
    fixed = np.clip(np.rint(means * (1 << fraction_bits)), -limit, limit - 1).astype("<i4")
    quaternions = raw.quaternions.double().numpy()[:, [1, 2, 3, 0]]  # [N, 4], (x, y, z, w)
    harmonics = raw.sh_rest.double().numpy() * np.array(HARMONICS)[:, None]  # [N, 15, 3]
    buckets = np.array(SH_BUCKETS)[:, None]
    steps = np.rint(harmonics * SH_STEPS) + SH_STEPS
    sections = [
        fixed.view(np.uint8).reshape(-1, 4)[:, :3],
        _to_bytes(torch.sigmoid(raw.opacity_logits.double()).numpy() * 255),
        _to_bytes((raw.sh_dc.double().numpy() * COLOR_SCALE + 0.5) * 255),
        _to_bytes((raw.log_scales.double().numpy() + SCALE_OFFSET) * SCALE_STEPS),
        smallest_three(quaternions * np.append(axes, 1.0)),
        _to_bytes((steps + buckets // 2) // buckets * buckets),
    ]
    return gzip.compress(header + b"".join(section.tobytes() for section in sections), mtime=0)


def warn_of_far_points(reach: NDArray[np.float64], size: float, fraction_bits: int) -> None:
    """Say so where ``fraction_bits`` are coarse beside ``size``, the usual size of a Gaussian (world units), and all
    but a thousandth of the Gaussians, whose largest coordinates are ``reach`` [N], could have more."""
    usual = float(np.quantile(reach, 1 - FAR_SHARE))
    step, possible = 2.0**-fraction_bits, 2.0 ** -fraction_bits_for(usual)
    if step > COARSE * size and possible < step:
        log.warning(
            "positions are kept to %.2g units, a Gaussian's usual size is %.2g: %d of %d Gaussians lie beyond %.3g "
            "units, as far as %.3g, and without them it would be %.2g; remove them before the export, or export a PLY",
            step, size, int((reach > usual).sum()), len(reach), usual, reach.max(), possible,
        )  # fmt: skip


def fraction_bits_for(largest: float) -> int:
    """The number of bits of a position that may be behind the point, so that ``largest`` fits before it."""
    before = max(0, math.frexp(largest)[1]) + 1  # and the sign
    return max(0, min(MAX_FRACTION_BITS, POSITION_BITS - before))


def smallest_three(quaternions: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Quaternions [N, 4] (x, y, z, w) in four bytes [N, 4]: which component is largest, and the three others."""
    unit = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    largest = np.abs(unit).argmax(axis=1)
    unit = unit * np.where(np.take_along_axis(unit, largest[:, None], axis=1) < 0, -1.0, 1.0)  # the largest is positive
    top = (1 << ROTATION_BITS) - 1
    magnitudes = np.floor(top * np.abs(unit) * math.sqrt(2) + 0.5).astype(np.uint32)  # none is above sqrt(1/2)
    fields = ((unit < 0).astype(np.uint32) << ROTATION_BITS) | np.minimum(magnitudes, top)
    packed = largest.astype(np.uint32)
    for component in range(4):
        shifted = (packed << (ROTATION_BITS + 1)) | fields[:, component]
        packed = np.where(largest == component, packed, shifted)
    return packed.astype("<u4").view(np.uint8).reshape(-1, 4)


def _to_bytes(values: NDArray[np.float64]) -> NDArray[np.uint8]:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)
