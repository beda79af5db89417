"""Pictures and point clouds of trials that nobody trained."""

import numpy as np
from PIL import Image
from plyfile import PlyData, PlyElement
from scipy.ndimage import gaussian_filter

PICTURE_SIZE = (120, 160)  # rows, columns
TEXTURED = slice(80, 160)  # columns of the ground truth that hold grass; the others are smooth


def write_pictures(path, densify, seed, views):
    """Write ground truth that is smooth on the left and grassy on the right, and renders.

    "adc" blurs the grass more than "volumetric". In the upper left corner "volumetric" is off
    by 20 levels, where "adc" is right.
    """
    noise = np.random.default_rng(seed)
    for folder in ("renders", "ground_truth"):
        (path / folder).mkdir()
    for view in range(views):
        rng = np.random.default_rng(view)
        rows, columns = np.mgrid[0 : PICTURE_SIZE[0], 0 : PICTURE_SIZE[1]]
        truth = np.stack([90 + rows / 3, 120 + columns / 4, 80 + rows / 4], axis=-1)
        grass = gaussian_filter(rng.normal(0, 160, PICTURE_SIZE), (3, 0.8))[:, TEXTURED, None]
        truth[:, TEXTURED] += grass * np.array([0.6, 1.0, 0.4])
        truth = np.clip(truth, 0, 255)
        blur = 3.0 if densify == "adc" else 1.0
        render = gaussian_filter(truth, (blur, blur, 0)) + noise.normal(0, 1, truth.shape)
        if densify == "volumetric":
            render[:40, :40] += 20
        for folder, image in (("renders", render), ("ground_truth", truth)):
            pixels = np.clip(image + 0.5, 0, 255).astype(np.uint8)
            Image.fromarray(pixels).save(path / f"{folder}/view{view:03d}.png")


def write_point_cloud(path, densify, seed):
    """Write a PLY with log-normal scales, smaller for "volumetric"."""
    rng = np.random.default_rng(seed)
    fields = ["x", "y", "z", "opacity", *(f"scale_{k}" for k in range(3))]
    vertices = np.zeros(2000, dtype=[(name, "f4") for name in fields])
    for axis in range(3):
        vertices[f"scale_{axis}"] = rng.normal(-4.0 if densify == "adc" else -4.5, 1.0, 2000)
    PlyData([PlyElement.describe(vertices, "vertex")]).write(path / "point_cloud.ply")
