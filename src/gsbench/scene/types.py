"""Types of a scene: a `Capture` of photographs on disk before initialisation, a `Scene` of views with cameras after."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsbench.scene.camera import Camera

EXTENT_MARGIN = 1.1  # 3DGS: cameras_extent = 1.1 x the largest distance of a training camera to their mean


@dataclass(frozen=True)
class Capture:
    """Photographs on disk, and the cameras that came with them, if any.

    ``images`` is the folder, ``image_names`` are the selected files in it (relative, sorted), and ``test_names`` are
    the held-out ones. ``held_out`` describes in words how they were chosen. ``model`` is a COLMAP sparse folder with
    reference cameras, or None for bare photographs; ``exact_poses`` says that its poses are the truth (a procedural
    scene), not an estimate. ``masks`` are mask files by image name; it is empty if every pixel counts. ``fingerprint``
    is a sha256 over names and contents of the selected images, their masks and the model. ``read_from`` are further
    files of the user that the cameras were read from.
    """

    name: str
    images: Path
    image_names: tuple[str, ...]
    test_names: tuple[str, ...]
    model: Path | None
    exact_poses: bool
    fingerprint: str
    held_out: str = ""
    masks: Mapping[str, Path] = field(default_factory=dict)
    read_from: tuple[Path, ...] = ()

    @property
    def train_names(self) -> tuple[str, ...]:
        held_out = set(self.test_names)
        return tuple(name for name in self.image_names if name not in held_out)


@dataclass(frozen=True)
class View:
    """One photograph with its camera; ``image`` is [H, W, 3] uint8, sRGB.

    ``mask`` [H, W] is True where a pixel counts, or None if all pixels count. Ignored pixels hold the colours made by
    `gsbench.scene.masks.fill_ignored`.
    """

    name: str
    camera: Camera
    image: NDArray[np.uint8]
    mask: NDArray[np.bool_] | None = None

    @property
    def counted(self) -> float:
        """The share of pixels that count."""
        return 1.0 if self.mask is None else float(self.mask.mean())


@dataclass(frozen=True)
class Scene:
    """The views that a trial trains on and is tested on, undistorted and at their final size."""

    name: str
    train: tuple[View, ...]
    test: tuple[View, ...]

    @cached_property
    def extent(self) -> float:
        """3DGS's ``cameras_extent`` of the training cameras, in world units."""
        return scene_extent([view.camera for view in self.train])


def scene_extent(cameras: Sequence[Camera]) -> float:
    """3DGS's ``cameras_extent`` of ``cameras``, in world units."""
    return extent_of_centers(np.stack([camera.center for camera in cameras]))


def extent_of_centers(centers: NDArray[np.float64]) -> float:
    """1.1 x the largest distance of a camera centre [V, 3] from their mean, in world units (3DGS's getNerfppNorm)."""
    return float(EXTENT_MARGIN * np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())
