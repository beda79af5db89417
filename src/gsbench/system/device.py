"""The torch device that a setting names, its precision and its memory."""

import torch

from gsbench.errors import InputError


def select_device(name: str, setting: str = "device") -> torch.device:
    """Return the device called ``name``; ``auto`` is the GPU if torch can use one, else the CPU.

    On a GPU, float32 is then not rounded to TF32 (`disable_tf32`). Raises InputError, which names
    the ``setting``, for a device that is not there or that another program holds.
    """
    available = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(available if name == "auto" else name)
    except RuntimeError as error:
        raise InputError(
            f"{setting}={name} is not known to torch; use auto, cpu, cuda or cuda:1"
        ) from error
    if device.type != "cuda":
        return device
    if available == "cpu":
        raise InputError(
            f"{setting}={name}: torch finds no CUDA device here; use {setting}=cpu, or install "
            "torch for CUDA"
        )
    if (device.index or 0) >= (count := torch.cuda.device_count()):
        raise InputError(f"{setting}={name}: there are {count} CUDA devices, numbered from 0")
    disable_tf32()
    try:
        torch.cuda.mem_get_info(device)
    except RuntimeError as error:
        reason = str(error).partition("\n")[0]
        raise InputError(
            f"{setting}={name}: {reason}; does another program hold the GPU (see nvidia-smi)?"
        ) from error
    return device


def disable_tf32() -> None:
    """Make GPUs compute float32 without rounding to TF32, in the whole process and in all passes.

    By default torch lets cuDNN's convolutions round to TF32, which has 10 bits. SSIM subtracts
    nearly equal moments: with TF32 its map had errors of up to 350, and its gradient was noise.
    """
    torch.backends.cudnn.allow_tf32 = False
    torch.backends.cuda.matmul.allow_tf32 = False


def free_bytes(device: torch.device) -> int | None:
    """The bytes of a GPU's memory that torch can still use; None for a CPU."""
    if device.type != "cuda":
        return None
    free, _ = torch.cuda.mem_get_info(device)
    # torch's cache counts as used for the driver, but torch itself can still use it.
    return free + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
