"""Write ``findings/archives/scenes.csv``: what distinguishes the captures, a row each.

    python findings/scripts/scenes.py PREPARED

``PREPARED`` is what ``captures.py`` wrote. `tables.py` holds these facts against the gain of the
volume rule.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pandas as pd
from PIL import Image

FACTS = Path(__file__).parents[1] / "archives" / "scenes.csv"
MAX_SIZE = 256  # px, as in training
EXTENT = (
    1.1  # 3DGS: the scene's extent is this times the largest distance of a camera from their mean
)
RENAMED = {"herz_jesus_p25": "herz_jesus"}  # as the claims call it


def facts_of(capture: Path) -> dict[str, float]:
    """Measure a capture with ``images`` and ``sparse/0``; lengths are in scene extents, angles in
    degrees.

    ``camera_distance``: of a point to the camera nearest to it, median. ``depth_spread``: in a
    view, the ratio of the 90 % and the 10 % quantile of the depths of its points, median over
    views. ``texture``: mean slope of luminance, in grey values a pixel. ``camera_angle``: between
    the axes of a camera and of the one nearest in angle, median. ``points_per_pixel``: points by
    all pixels of all views.
    """
    import pycolmap

    model = pycolmap.Reconstruction(capture / "sparse" / "0")
    points = np.array([point.xyz for point in model.points3D.values()])  # [P, 3]
    poses = [image.cam_from_world().matrix() for image in model.images.values()]  # each [3, 4]
    centres = np.array([-pose[:, :3].T @ pose[:, 3] for pose in poses])  # [V, 3]
    axes = np.array([pose[2, :3] for pose in poses])  # [V, 3] where each camera looks
    extent = EXTENT * np.linalg.norm(centres - centres.mean(0), axis=1).max()

    nearest = np.linalg.norm(points[:, None] - centres[None], axis=2).min(1)  # [P]
    cosines = np.clip(axes @ axes.T, -1, 1)
    np.fill_diagonal(cosines, -1)
    pixels, slopes, spreads = 0, [], []
    for image, pose in zip(model.images.values(), poses, strict=True):
        with Image.open(capture / "images" / image.name) as picture:
            picture.thumbnail((MAX_SIZE, MAX_SIZE))
            grey = np.asarray(picture.convert("L"), float)
        pixels += grey.size
        slopes.append(np.hypot(*np.gradient(grey)).mean())
        seen = np.array(
            [
                model.points3D[p.point3D_id].xyz
                for p in image.points2D
                if p.point3D_id in model.points3D
            ]
        )
        if len(seen) > 1:
            low, high = np.quantile(seen @ pose[2, :3] + pose[2, 3], (0.1, 0.9))
            spreads.append(high / low)
    return {
        "views": len(poses),
        "points_per_pixel": len(points) / pixels,
        "camera_distance": float(np.median(nearest)) / extent,
        "depth_spread": float(np.median(spreads)),
        "texture": float(np.mean(slopes)),
        "camera_angle": float(np.degrees(np.arccos(np.median(cosines.max(1))))),
    }


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    captures = sorted(folder.parents[1] for folder in Path(sys.argv[1]).glob("*/sparse/0"))
    table = pd.DataFrame({RENAMED.get(one.name, one.name): facts_of(one) for one in captures}).T
    table.rename_axis("scene").to_csv(FACTS, float_format="%.4g")
    print(table.to_string())
