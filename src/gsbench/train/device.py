"""The device that a trial runs on, and what it must not do to float32."""

from __future__ import annotations

import torch

from gsbench.errors import InputError


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
