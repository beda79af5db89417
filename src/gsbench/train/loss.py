"""The photometric loss of 3DGS, ``(1 - w) L1 + w (1 - SSIM)`` with w = 0.2.

This module has its definition in torch, and chooses the fastest implementation for a device. SSIM
is that of `gsbench.eval.ssim`: images are padded with zeros, and the result is the mean over the
whole map, as in the reference code of 3DGS.
"""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from gsbench.eval.images import as_unit_range
from gsbench.eval.ssim import ssim_map
from gsbench.raster.executors import find_executor

SSIM_WEIGHT = 0.2
# False if the kernels for CPU and GPU do not compute what ``torch_photometric_loss`` does: then
# every device uses that function, and steps on a GPU are not recorded.
HAS_KERNELS = True

Loss = Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]


def torch_photometric_loss(
    image: Tensor, target: Tensor, ssim_weight: float = SSIM_WEIGHT
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute ``photometric_loss`` in torch: its definition, for any device and floating dtype."""
    target = as_unit_range(target, image.dtype)
    l1 = (image - target).abs().mean()
    similarity = ssim_map(image, target).mean()
    loss = (1 - ssim_weight) * l1 + ssim_weight * (1 - similarity)
    return loss, l1.detach(), similarity.detach()


def photometric_loss(
    image: Tensor, target: Tensor, ssim_weight: float = SSIM_WEIGHT
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the loss, L1 and SSIM of ``image`` [H, W, 3] against ``target`` [H, W, 3].

    ``target`` is floating, or uint8, which is divided by 255. The results are scalars; only the
    loss has a gradient, by ``image``. For many images, use a ``PhotometricLoss``, which is faster:
    it has threads and reuses memory.
    """
    return PhotometricLoss(ssim_weight, threads=1)(image, target)


class PhotometricLoss:
    """``photometric_loss`` as an object that reuses compiled kernels for float32 images.

    On a CPU, kernels run on ``threads`` threads; results have the same bits for any number of them.
    On a GPU with Triton, the host never waits for the device. Other devices and dtypes use torch.
    """

    def __init__(self, ssim_weight: float = SSIM_WEIGHT, threads: int | None = None) -> None:
        if not 0 <= ssim_weight <= 1:
            raise ValueError(f"ssim_weight: must be between 0 and 1, got {ssim_weight}")
        self.ssim_weight = ssim_weight
        self._threads = threads
        self._compiled: dict[str, Loss] = {}  # by type of device

    def __call__(self, image: Tensor, target: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        if image.dim() != 3 or image.shape[-1] != 3 or image.shape != target.shape:
            raise ValueError(
                f"image {tuple(image.shape)} and target {tuple(target.shape)} must have one "
                "shape: [H, W, 3]"
            )
        if image.dtype != torch.float32:
            return torch_photometric_loss(image, target, self.ssim_weight)
        return self.implementation(image.device.type)(image, target)

    def implementation(self, device_type: str) -> Loss:
        """The loss of float32 images on a type of device."""
        if device_type not in self._compiled:
            self._compiled[device_type] = self._compile(device_type)
        return self._compiled[device_type]

    def _compile(self, device_type: str) -> Loss:
        """Return the loss for a type of device; import only the packages that it needs."""
        if HAS_KERNELS and device_type == "cpu":
            from gsbench.train.loss_cpu import CompiledLoss

            return CompiledLoss(self.ssim_weight, self._threads)
        if HAS_KERNELS and find_executor("triton").obstacle(device_type) is None:
            from gsbench.train.loss_triton import TritonLoss

            return TritonLoss(self.ssim_weight)
        return partial(torch_photometric_loss, ssim_weight=self.ssim_weight)
