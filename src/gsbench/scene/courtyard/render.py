"""The built-in scene: a procedural courtyard, rendered to photographs with exactly known cameras.

It has a well, crates, a bench, pots, a gravel path, stone walls and a house front, with detail for
structure from motion, and a large lawn of faint texture, on which 3DGS grows oversized Gaussians.
Equal seeds give equal images.
"""

from math import cos, pi, radians, sin, tan
from pathlib import Path

import numpy as np
from PIL import Image

from gsbench.logs import Progress, no_progress
from gsbench.scene.courtyard.kernels import render
from gsbench.scene.courtyard.layout import Layout, build_layout
from gsbench.scene.types import ByteArray, Camera
from gsbench.system.resources import in_threads

# azimuth between neighbouring views; larger steps gave wrong SfM models of scenes like this one
MAX_STEP = radians(7.5)
RING_RADIUS = 4.55  # m
FIELD_OF_VIEW = radians(56.0)  # horizontal
TARGET = (0.0, 0.0, 0.72)  # m, the point that all cameras look at


def render_courtyard(
    output_dir: Path,
    views: int,
    width: int,
    height: int,
    seed: int = 0,
    progress: Progress = no_progress,
) -> None:
    """Write the capture: ``images/*.png`` and the exact COLMAP model ``sparse/0`` without points.

    ``width`` and ``height`` are in px. The same arguments give the same bytes. ``progress`` counts
    views.
    """
    # This module loads pycolmap, which is slow and needed only here.
    from gsbench.scene.colmap import write_model

    cameras = courtyard_cameras(views, width, height)
    layout = build_layout(seed)
    images = output_dir / "images"
    images.mkdir(parents=True, exist_ok=True)

    def work(item: tuple[str, Camera]) -> None:
        name, camera = item
        Image.fromarray(render_view(layout, camera, seed)).save(images / name, format="PNG")

    for done, _ in enumerate(in_threads(work, cameras.items()), start=1):
        progress("courtyard", done, views)
    write_model(output_dir / "sparse" / "0", cameras)


def courtyard_cameras(views: int, width: int, height: int) -> dict[str, Camera]:
    """The cameras by file name, on a wavy ring around the courtyard's centre.

    Steps are 7.5 degrees, or less for more than 48 views, which fill the ring.
    """
    step = min(MAX_STEP, 2 * pi / views)
    angles = [index * step - 0.5 * pi for index in range(views)]
    return {f"{k:04d}.png": ring_camera(angle, width, height) for k, angle in enumerate(angles)}


def ring_camera(angle: float, width: int, height: int) -> Camera:
    """The camera at azimuth ``angle`` (rad); its height and distance vary smoothly with it."""
    radius = RING_RADIUS + 0.2 * cos(2 * angle)
    center = np.array([radius * cos(angle), radius * sin(angle), 1.95 + 0.40 * sin(5 * angle)])
    forward = np.array(TARGET) - center
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])  # [3, 3] world to camera
    focal = 0.5 * width / tan(0.5 * FIELD_OF_VIEW)
    return Camera(width, height, focal, focal, width / 2, height / 2, rotation, -rotation @ center)


def render_view(layout: Layout, camera: Camera, seed: int) -> ByteArray:
    """Render one photograph, [H, W, 3] uint8 sRGB; a matt surface has one colour in all views."""
    image = np.empty((camera.height, camera.width, 3), dtype=np.uint8)
    pose = np.ascontiguousarray(camera.rotation), np.ascontiguousarray(camera.center)
    render(layout, *pose, camera.params, image, seed)
    return image
