"""The device of a training: which it is, what it rounds, and whether the training fits into its memory."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import torch

from gsbench.errors import InputError, TrainingError
from gsbench.raster.triton.launch import render_bytes
from gsbench.words import readable_bytes


def select_device(name: str) -> torch.device:
    """``auto`` is the GPU where torch can use one, else the CPU."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise InputError(f"device={name} is not known to torch; use auto, cpu, cuda or cuda:1") from error
    if device.type == "cuda" and not torch.cuda.is_available():
        raise InputError(
            f"device={name}: torch finds no CUDA device here; use device=cpu, or install a CUDA build of torch"
        )
    if device.type == "cuda" and device.index is not None and device.index >= torch.cuda.device_count():
        raise InputError(f"device={name}: there are {torch.cuda.device_count()} CUDA devices, numbered from 0")
    if device.type == "cuda":
        keep_float32()
    return device


def keep_float32() -> None:
    """Let GPUs compute float32 as float32 in the whole process, also in backward passes.

    torch lets cuDNN's convolutions round to TF32, 10 bits, by default. SSIM takes differences of nearly equal moments:
    with TF32 its map was off by up to 350 and its gradient was noise.
    """
    torch.backends.cudnn.allow_tf32 = False
    torch.backends.cuda.matmul.allow_tf32 = False


# Bytes a Gaussian. Its 59 numbers are held four times: parameters, gradient and Adam's two moments.
BYTES_OF_MODEL = 59 * 4 * 4
# Largest parameter and its moments once more while Gaussians are added; statistics of a densifier; of a render, radii,
# screen points and their gradients, and what sorting by depth takes.
BYTES_OF_WORK = 45 * 4 * 3 + 16 + 48
# Bytes a pixel: image, opacity, their gradients, the training image, maps of SSIM.
BYTES_OF_PIXEL = 152

BLOCK_PIXELS = 128  # of raster=triton, whose lists are counted here


@dataclass(frozen=True)
class Crowding:
    """Numbers of (Gaussian, block) pairs of a view: bounds of what `raster=triton` counts on the scenes of `bench`, at
    100,000 and 1,000,000 Gaussians, 500x375 and 1600x1060 px (docs/gpu.md)."""

    pairs_of_gaussian: float
    pairs_of_pixel: float
    units_of_pair: float  # rows of blocks

    def pairs(self, gaussians: int, pixels: int) -> int:
        return int(self.pairs_of_gaussian * gaussians + self.pairs_of_pixel * pixels)


INITIAL = Crowding(14, 3.5, 0.3)  # as the random scene: faint balls as large as they are apart
TRAINED = Crowding(3, 0.75, 0.55)  # as the skewed scene

log = logging.getLogger(__name__)


def training_bytes(gaussians: int, pixels: int, crowding: Crowding = TRAINED) -> int:
    """Estimate the bytes that a training of so many Gaussians holds at once, in images of so many pixels."""
    pairs = crowding.pairs(gaussians, pixels)
    rendering = render_bytes(gaussians, int(crowding.units_of_pair * pairs), pairs, pixels // BLOCK_PIXELS)
    return gaussians * (BYTES_OF_MODEL + BYTES_OF_WORK) + pixels * BYTES_OF_PIXEL + rendering


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
    needed = training_bytes(initial, pixels, INITIAL)
    if needed > free:
        raise TrainingError(
            f"{initial:,} initial Gaussians need about {readable_bytes(needed)} of the device's memory, and "
            f"{readable_bytes(free)} are free: {ADVICE}"
        )
    at_cap = max(needed, training_bytes(max(initial, cap or 0), pixels))
    if at_cap > free:
        log.warning(
            "with the %s Gaussians that densify.max_gaussians allows, this training needs about %s of the device's "
            "memory, and %s are free; if it grows so far, %s",
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
