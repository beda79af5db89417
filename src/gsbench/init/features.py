"""Local features of one image: keypoints, descriptors and scores, with the image sizes that give them a meaning."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from gsbench.errors import InputError
from gsbench.scene.images import read_image
from gsbench.scene.sizes import downscaled_size

GPU_MEMORY_MEND = "lower init.max_image_size or init.max_keypoints, or set init.device=cpu"


@dataclass(frozen=True, eq=False)
class Features:
    """Features of one image, strongest first.

    ``keypoints`` [K, 2] float32 are px of the image as the network saw it, the centre of its first pixel being (0, 0);
    `colmap_keypoints` are the same in px of the file. ``descriptors`` are [K, D] float32, ``scores`` [K] float32.
    """

    keypoints: NDArray[np.float32]
    descriptors: NDArray[np.float32]
    scores: NDArray[np.float32]
    network_size: tuple[int, int]  # width, height in px
    file_size: tuple[int, int]

    @property
    def colmap_keypoints(self) -> NDArray[np.float32]:
        """Keypoints [K, 2] in px of the file, the centre of its first pixel being (0.5, 0.5), as COLMAP has it."""
        scale = np.array(self.file_size, dtype=np.float64) / self.network_size
        return ((self.keypoints.astype(np.float64) + 0.5) * scale).astype(np.float32)

    def strongest(self, count: int) -> Features:
        """The first ``count`` features."""
        return Features(
            self.keypoints[:count],
            self.descriptors[:count],
            self.scores[:count],
            self.network_size,
            self.file_size,
        )


class Extractor(Protocol):
    """Finds features in an image [1, 3, H, W], RGB in [0, 1].

    Returns keypoints [K, 2] in px with the centre of the first pixel at (0, 0), descriptors [K, D] and scores [K].
    """

    def __call__(self, image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]: ...


def extract_features(
    path: Path, extractor: Extractor, max_image_size: int, max_keypoints: int, device: torch.device
) -> Features:
    """The ``max_keypoints`` strongest features of an image file, shrunk to ``max_image_size`` px for the network.

    Raises ``InputError`` where the image cannot be read or the device runs out of memory.
    """
    pixels = read_image(path)  # [H, W, 3]
    height, width = pixels.shape[:2]
    network_size = downscaled_size(width, height, max_size=max_image_size)
    if network_size != (width, height):
        pixels = np.asarray(Image.fromarray(pixels).resize(network_size, Image.Resampling.LANCZOS))
    image = torch.from_numpy(pixels.astype(np.float32) / 255.0).permute(2, 0, 1)[None]  # [1, 3, h, w]
    try:
        with torch.inference_mode():
            keypoints, descriptors, scores = (part.float().cpu() for part in extractor(image.to(device)))
    except torch.OutOfMemoryError as error:
        size = f"{network_size[0]}x{network_size[1]}"
        raise InputError(f"{path.name}: {device} ran out of memory at {size} px: {GPU_MEMORY_MEND}") from error
    order = torch.sort(scores, descending=True, stable=True).indices[:max_keypoints]
    return Features(
        keypoints[order].numpy(), descriptors[order].numpy(), scores[order].numpy(), network_size, (width, height)
    )
