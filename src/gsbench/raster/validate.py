"""The input checks that all rasterizers share: one ValueError that names the parameter."""

from __future__ import annotations

import torch
from torch import Tensor

from gsbench.gaussians.model import MAX_SH_DEGREE, Gaussians
from gsbench.scene.camera import Camera

MAX_SIDE = 16384  # px; beyond it an image is taken for a slip in the settings, not for a wish
MIN_QUATERNION_NORM = 1e-12  # below, torch's ``normalize`` no longer gives a unit quaternion, so no rotation
FOCAL_RANGE = (1e-3, 1e6)  # focal length over image side: fields of view between 0.2 arc seconds and 179.8 degrees
MAX_PRINCIPAL_OFFSET = 100.0  # image sides that the principal point may lie outside the image


def check_inputs(gaussians: Gaussians, camera: Camera, sh_degree: int, background: Tensor) -> None:
    """Raise ValueError, naming the parameter, on anything that ``Rasterizer.render`` cannot use.

    Looks at every value of ``gaussians``, and waits for a device once. An executor that meets the values anyway calls
    ``check_settings`` alone and ``raise_for_values`` when it finds a bad one; one that waits for its device later asks
    ``bad_values`` and reads the answer then.
    """
    check_settings(gaussians, camera, sh_degree, background)
    if bad_values(gaussians, background):
        raise_for_values(gaussians, background)


def bad_values(gaussians: Gaussians, background: Tensor) -> Tensor:
    """One bool, still on the device: whether ``raise_for_values`` has to look.

    It may be True for sound values whose sum overflows; it is never False for a bad one.
    """
    tensors = [background, *gaussians.tensors().values()]
    bad = ~torch.stack([tensor.detach().sum() for tensor in tensors]).isfinite().all()
    if len(gaussians):
        bad = bad | (gaussians.quaternions.detach().norm(dim=-1).amin() < MIN_QUATERNION_NORM)
    return bad


def check_settings(gaussians: Gaussians, camera: Camera, sh_degree: int, background: Tensor) -> None:
    """The part of ``check_inputs`` that looks at no value that a device would have to be waited for."""
    if not 0 <= sh_degree <= MAX_SH_DEGREE:
        raise ValueError(f"sh_degree: must be 0 to {MAX_SH_DEGREE}, got {sh_degree}")
    dtype, device = gaussians.means.dtype, gaussians.means.device
    if dtype not in (torch.float32, torch.float64):
        raise ValueError(f"gaussians: dtype must be float32 or float64, got {dtype}")
    for name, tensor in [*gaussians.tensors().items(), ("background", background)]:
        if tensor.dtype != dtype or tensor.device != device:
            raise ValueError(f"{name}: is {tensor.dtype} on {tensor.device}, but means is {dtype} on {device}")
    if tuple(background.shape) != (3,):
        raise ValueError(f"background: must be three numbers, got shape {tuple(background.shape)}")
    if device.type == "cpu":
        _check_background(background)
    _check_camera(camera)


def _check_camera(camera: Camera) -> None:
    for side, size, focal, principal in (
        ("width", camera.width, camera.fx, camera.cx),
        ("height", camera.height, camera.fy, camera.cy),
    ):
        axis = "x" if side == "width" else "y"
        if size > MAX_SIDE:
            raise ValueError(f"camera: {side} is {size} px, more than {MAX_SIDE}; resize the images")
        if not FOCAL_RANGE[0] * size <= focal <= FOCAL_RANGE[1] * size:
            raise ValueError(f"camera: f{axis} is {focal} px, which is degenerate for a {side} of {size} px")
        if abs(principal) > MAX_PRINCIPAL_OFFSET * size:
            raise ValueError(f"camera: c{axis} is {principal} px, which is degenerate for a {side} of {size} px")


def _check_background(background: Tensor) -> None:
    if not torch.isfinite(background).all():
        raise ValueError(f"background: must be three finite numbers, got {background.tolist()}")


def raise_for_values(gaussians: Gaussians, background: Tensor | None = None) -> None:
    """Raise ValueError on the first parameter that has a non-finite value or, of quaternions, no length."""
    if background is not None:
        _check_background(background)
    for name, tensor in gaussians.tensors().items():
        finite = torch.isfinite(tensor.detach())
        while finite.dim() > 1:
            finite = finite.all(-1)  # in the end [N]
        if not finite.all():
            index = int((~finite).nonzero()[0])
            raise ValueError(f"{name}: not finite at Gaussian {index} ({int((~finite).sum())} in all)")
    short = gaussians.quaternions.detach().norm(dim=-1) < MIN_QUATERNION_NORM  # [N]
    if short.any():
        index = int(short.nonzero()[0])
        raise ValueError(f"quaternions: no length, so no rotation, at Gaussian {index} ({int(short.sum())} in all)")
