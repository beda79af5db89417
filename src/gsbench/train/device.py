"""The device of a training: which it is, what it rounds, how much memory is free, and what to say when it is full."""

import torch

from gsbench.errors import InputError, TrainingError


def select_device(name: str) -> torch.device:
    """``auto`` is the GPU where torch can use one, else the CPU."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise InputError(f"device={name} is not known to torch; use auto, cpu, cuda or cuda:1") from error
    if device.type == "cuda" and not torch.cuda.is_available():
        raise InputError(f"device={name}: torch finds no CUDA device here; use device=cpu, or install torch for CUDA")
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


def free_bytes(device: torch.device) -> int | None:
    """The bytes that torch can still take of a GPU's memory; None for a CPU, whose memory others give back."""
    if device.type != "cuda":
        return None
    free, _ = torch.cuda.mem_get_info(device)
    return free + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)


ADVICE = (
    "lower densify.max_gaussians, scene.max_size or the number of trials at once (launch.parallel), or end other "
    "programs on that device"
)


def explain_full(step: int, gaussians: int, device: torch.device, last_state: str) -> TrainingError:
    """The error for a device whose memory is full at iteration ``step``."""
    return TrainingError(
        f"iteration {step}: {device} has no memory left at {gaussians:,} Gaussians; {last_state}; {ADVICE}"
    )
