"""A reader of scenes; docs/library.md says how to run it."""

from dataclasses import dataclass

import numpy as np

from gsbench.scene.record import Photograph, RawCapture
from gsbench.scene.types import CameraModel


@dataclass
class LLFF:
    """Photographs in a folder, with cameras from LLFF's poses_bounds.npy."""

    photographs: str = "images"

    def read(self, folder):
        file = folder / "poses_bounds.npy"
        rows = np.load(file)[:, :15].reshape(-1, 3, 5)
        files = sorted((folder / self.photographs).iterdir())
        found = []
        for photograph, row in zip(files, rows, strict=True):
            # the camera's axes in the world, its centre, and its size and focal length in px
            down, right, back, center, (height, width, focal) = row.T
            rotation = np.stack([right, down, -back])  # from the world to the camera
            params = (focal, width / 2, height / 2)
            camera = CameraModel("SIMPLE_PINHOLE", int(width), int(height), params)
            name = photograph.relative_to(folder).as_posix()
            found.append(Photograph(name, photograph, camera, rotation, -rotation @ center))
        return RawCapture(folder, tuple(found), files=(file,))
