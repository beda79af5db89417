"""Memory budget of a training on its device: an estimate before it starts, and advice when it does not fit."""

from __future__ import annotations

import logging

import torch

from gsbench.errors import TrainingError
from gsbench.words import readable_bytes

# Bytes a Gaussian. Its 59 numbers are held four times: parameters, gradient and Adam's two moments.
BYTES_OF_MODEL = 59 * 4 * 4
# Largest parameter and its moments once more while Gaussians are added; records, lists and gradient rows of a
# rasterizer (about: measured in docs/gpu.md); statistics of a densifier.
BYTES_OF_WORK = 45 * 4 * 3 + 400 + 16
# Bytes a pixel: image, opacity, their gradients, what compositing leaves for the backward pass, maps of SSIM.
BYTES_OF_PIXEL = 160

log = logging.getLogger(__name__)


def training_bytes(gaussians: int, pixels: int) -> int:
    """Estimate the bytes that a training of so many Gaussians holds at once, in images of so many pixels."""
    return gaussians * (BYTES_OF_MODEL + BYTES_OF_WORK) + pixels * BYTES_OF_PIXEL


def free_bytes(device: torch.device) -> int | None:
    """The bytes that torch can still take of a GPU's memory; None for a CPU, whose memory others give back."""
    if device.type != "cuda":
        return None
    free, _ = torch.cuda.mem_get_info(device)
    return free + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)


def room_for_images(free: int | None, initial: int, cap: int | None, pixels: int) -> int | None:
    """The bytes that training images may take beside a training from ``initial`` up to ``cap`` Gaussians.

    None: no limit. Raises TrainingError where not even the initial Gaussians fit into ``free`` bytes, and warns where
    those of the cap do not.
    """
    if free is None:
        return None
    needed = training_bytes(initial, pixels)
    if needed > free:
        raise TrainingError(
            f"{initial:,} initial Gaussians need about {readable_bytes(needed)} of the device's memory, and "
            f"{readable_bytes(free)} are free: {ADVICE}"
        )
    at_cap = training_bytes(max(initial, cap or 0), pixels)
    if at_cap > free:
        log.warning(
            "with the %s Gaussians that densify.max_gaussians allows, this training needs about %s of the device's "
            "memory, and %s are free; should it grow so far, %s",
            f"{cap:,}", readable_bytes(at_cap), readable_bytes(free), ADVICE,
        )  # fmt: skip
    return max(0, free - at_cap)


ADVICE = (
    "lower densify.max_gaussians, scene.max_size or the number of trials at once (launch.parallel), or end other "
    "programs on that device"
)


def explain_full(step: int, gaussians: int, device: torch.device, last_state: str) -> TrainingError:
    """The error for a device whose memory is full at iteration ``step``."""
    return TrainingError(
        f"iteration {step}: {device} has no memory left at {gaussians:,} Gaussians; {last_state}; {ADVICE}"
    )
