"""A first guess of how long a training takes: from the size of pictures and a count of Gaussians.

It is used as long as no finished trial tells more. Loads no torch.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from gsbench.scene.names import IMAGE_SUFFIXES
from gsbench.scene.options import downscaled_size
from gsbench.system.resources import available_threads, installed_gpus

# Seconds of a step, measured (docs/measurements.md). On one thread of a CPU: projecting, sorting,
# their gradients and Adam for each Gaussian, compositing, its gradient and the loss for each pixel.
# On an H100: 100,000 and 1 million Gaussians took 1.3 and 3.0 ms.
CPU_OF_GAUSSIAN, CPU_OF_PIXEL = 0.0241 / 100_000, 0.0294 / (500 * 375)
GPU_OF_STEP, GPU_OF_GAUSSIAN = 0.0011, 1.9e-9
THREADS, SPEED_UP = (1, 2, 4, 8, 16), (1, 1.9, 3.4, 5.5, 6.3)
# A trained courtyard has 0.46 Gaussians for each pixel of a picture.
GAUSSIANS_OF_PIXEL = 0.46
MAX_ENTRIES = 10_000  # of a folder that are looked at for a picture


@dataclass(frozen=True)
class Guess:
    """The seconds of a training, and what they rest on."""

    seconds: float
    width: int
    height: int
    gaussians: int
    on_gpu: bool

    def __str__(self) -> str:
        device = "an H100" if self.on_gpu else "this CPU"
        return (
            f"a first guess for trainings on {device}, from pictures of {self.width}×{self.height} "
            f"px and {self.gaussians:,} Gaussians"
        )


def guess_training(values: Mapping[str, Any], parallel: int = 1) -> Guess | None:
    """The guess for a trial's resolved values; None without a picture."""
    size = picture_size(values["scene"])
    if size is None:
        return None
    pixels = size[0] * size[1]
    gaussians = round(GAUSSIANS_OF_PIXEL * pixels)
    gaussians = min(gaussians, values["densify"].get("max_gaussians") or gaussians)
    on_gpu = values["device"] != "cpu" and has_gpu()
    if on_gpu:
        step = GPU_OF_STEP + GPU_OF_GAUSSIAN * gaussians
    else:
        given = values["threads"]
        threads = available_threads(parallel) if given == "auto" else given
        step = CPU_OF_GAUSSIAN * gaussians + CPU_OF_PIXEL * pixels
        step /= float(np.interp(threads, THREADS, SPEED_UP))
    return Guess(step * values["train"]["iterations"], *size, gaussians, on_gpu)


def picture_size(scene: Mapping[str, Any]) -> tuple[int, int] | None:
    """The size, in px, to which the first picture of a scene is brought for the training."""
    size = _first_size(scene.get("path") or "", scene.get("images") or "images")
    if scene.get("kind") == "courtyard":
        size = scene["width"], scene["height"]
    if size is None:
        return None
    return downscaled_size(*size, scene.get("downscale") or 1, scene.get("max_size"))


@cache
def has_gpu() -> bool:
    return bool(installed_gpus())


@cache
def _first_size(path: str, images: str) -> tuple[int, int] | None:
    folder = Path(path).expanduser()
    for place in (folder / images, folder) if path else ():
        for file in _files(place):
            try:
                with Image.open(file) as picture:  # reads the header alone
                    return picture.size
            except (OSError, ValueError, Image.DecompressionBombError):
                continue
    return None


def _files(folder: Path) -> Iterator[Path]:
    if folder.is_dir():
        for _, file in zip(range(MAX_ENTRIES), folder.iterdir(), strict=False):
            if file.suffix.lower() in IMAGE_SUFFIXES and file.is_file():
                yield file
