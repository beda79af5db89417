"""The report on a model: its content, pose errors against the reference, the meaning of V_th, and a
picture."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from importlib import metadata
from math import floor, log10
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from PIL import Image, ImageDraw

from gsbench.gaussians.paper_values import VOLUME_THRESHOLD
from gsbench.init.base import MODEL_FOLDER, PICTURE_FILE, REPORT_FILE, Gauge, InitReport, PoseErrors
from gsbench.init.colmap.alignment import Similarity, rotation_angles, transformed_rotations
from gsbench.init.colmap.reconstruct import common_poses, poses_by_name, save_reconstruction
from gsbench.scene.colmap import model_points
from gsbench.scene.types import Array, Capture, extent_of_centers

SIDE, MARGIN = 960, 60  # px
MAX_POINTS = 200_000  # drawn; more would only cover each other
VISIBLE_SHARE = 0.98  # of the points: distant outliers must not shrink the rest to a dot
# third over second singular value of the camera centres: below it they lie in a plane
PLANE_RATIO = 0.5
LINE_RATIO = 0.05  # second over first: below it they lie on a line
VIEW_LINE = 0.06  # length of the lines of sight, as a share of the picture's side
CAMERA_COLOR = (214, 39, 40)


def draw_cloud(model: pycolmap.Reconstruction, path: Path, title: str) -> None:
    """Draw a model from above into the PNG ``path``: points in their colours, cameras in red with
    lines of sight."""
    points, colors = model_points(model)
    if len(points) > MAX_POINTS:
        chosen = np.random.default_rng(0).permutation(len(points))[:MAX_POINTS]
        points, colors = points[chosen], colors[chosen]
    images = [image for _, image in sorted(model.images.items()) if image.has_pose]
    centers = np.array([image.projection_center() for image in images]).reshape(-1, 3)
    rotations = np.array([image.cam_from_world().rotation.matrix() for image in images]).reshape(
        -1, 3, 3
    )
    axes = view_from_above(centers, rotations, points)  # [3, 3]
    # the highest points are drawn last, over lower ones
    order = np.argsort(points @ axes[2], kind="stable")
    flat, flat_centers = points[order] @ axes[:2].T, centers @ axes[:2].T  # [P, 2], [V, 2]
    low, high = _limits(flat, flat_centers)
    scale = (SIDE - 2 * MARGIN) / (high - low).max()  # px for a unit of the model

    def pixels(positions: Array) -> Array:
        return SIDE / 2 + (positions - (low + high) / 2) * scale * (1, -1)

    canvas = np.full((SIDE, SIDE, 3), 255, dtype=np.uint8)
    columns, rows = np.floor(pixels(flat)).astype(np.int64).T  # [P] each
    size = 1 if len(flat) > 50_000 else 2 if len(flat) > 5_000 else 3  # px of a point
    for dx, dy in np.ndindex(size, size):
        inside = (columns + dx >= 0) & (columns + dx < SIDE) & (rows + dy >= 0) & (rows + dy < SIDE)
        canvas[rows[inside] + dy, columns[inside] + dx] = colors[order][inside]
    picture = Image.fromarray(canvas)
    draw = ImageDraw.Draw(picture)
    sights = flat_centers + VIEW_LINE * (high - low).max() * rotations[:, 2] @ axes[:2].T  # [V, 2]
    for (x, y), (to_x, to_y) in zip(pixels(flat_centers), pixels(sights), strict=True):
        draw.line((x, y, to_x, to_y), fill=CAMERA_COLOR, width=2)
        draw.ellipse((x - 3, y - 3, x + 3, y + 3), fill=CAMERA_COLOR)
    draw.text((MARGIN, 16), title, fill="black", font_size=18)
    bar = 10.0 ** floor(log10((high - low).max() / 2))  # model units
    draw.line((MARGIN, SIDE - 24, MARGIN + bar * scale, SIDE - 24), fill="black", width=3)
    draw.text((MARGIN, SIDE - 48), f"{bar:g} model units", fill="black", font_size=16)
    picture.save(path, format="PNG")


def view_from_above(centers: Array, rotations: Array, points: Array) -> Array:
    """Unit vectors [3, 3] right, away and up, in world coordinates.

    Up is the normal of the plane of the camera centres [V, 3] or, if they lie in no plane, the mean
    of the images' upward directions. The normal's sign agrees with the images' upward directions;
    for cameras that look down, it puts the cameras above ``points``. ``rotations`` [V, 3, 3] are
    world to camera.
    """
    image_up = -rotations[:, 1].mean(axis=0)  # [3]: y points down in the image
    _, spread, directions = np.linalg.svd(centers - centers.mean(axis=0), full_matrices=False)
    in_plane = (
        len(centers) >= 3
        and spread[1] > LINE_RATIO * spread[0]
        and spread[2] < PLANE_RATIO * spread[1]
    )
    up = directions[2] if in_plane else image_up
    towards = image_up
    if abs(up @ image_up) < 0.5 and len(points) > 0:
        towards = centers.mean(axis=0) - np.median(points, axis=0)
    up = up / np.linalg.norm(up) * (1.0 if up @ towards >= 0 else -1.0)
    # the first camera's right is the picture's right
    right = rotations[0, 0] - (rotations[0, 0] @ up) * up
    if np.linalg.norm(right) < 1e-6:
        right = np.eye(3)[np.argmin(np.abs(up))] - up[np.argmin(np.abs(up))] * up
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(up, right), up])


def _limits(flat: Array, centers: Array) -> tuple[Array, Array]:
    """Lower left and upper right corner: all cameras, and most of the points."""
    tail = (1 - VISIBLE_SHARE) / 2
    corners = (
        [centers] if len(flat) == 0 else [centers, np.quantile(flat, [tail, 1 - tail], axis=0)]
    )
    together = np.concatenate(corners)
    low, high = together.min(axis=0), together.max(axis=0)
    margin = 0.05 * max(float((high - low).max()), 1e-9)
    return low - margin, high + margin


REGISTERED_SHARE = 0.9  # the report warns if fewer of the images have a pose
# correct models stay below 0.5; wrong ones that register every image reach 20 and more
ROTATION_WARNING_DEG = 2.0
CENTER_WARNING = 0.05  # of the reference's scene extent
# correct models stay below 0.7 px with SIFT, below 1.2 px with learned features
REPROJECTION_WARNING_PX = 1.5
FIELD_OF_VIEW_DEG = (5.0, 150.0)  # plausible range, along the longest side
FEW_POINTS = 100


def training_extent(model: pycolmap.Reconstruction, capture: Capture) -> float:
    """3DGS's ``cameras_extent`` of the training images with a pose in the model, or 0 if there are
    none."""
    poses = poses_by_name(model)
    centers = [poses[name][0] for name in capture.train_names if name in poses]
    return extent_of_centers(np.array(centers)) if centers else 0.0


def measure_gauge(extent: float, scale_to_reference: float | None) -> Gauge:
    """Express the paper's V_th in a model with this scene extent."""
    radius = (3 * VOLUME_THRESHOLD / (4 * math.pi)) ** (1 / 3)
    return Gauge(
        scene_extent=extent,
        scale_to_reference=scale_to_reference,
        volume_threshold=VOLUME_THRESHOLD,
        threshold_over_extent_cubed=VOLUME_THRESHOLD / extent**3 if extent > 0 else None,
        threshold_radius=radius,
        threshold_radius_over_extent=radius / extent if extent > 0 else None,
        threshold_in_reference=None
        if scale_to_reference is None
        else VOLUME_THRESHOLD * scale_to_reference**3,
    )


def compare_poses(
    model: pycolmap.Reconstruction,
    reference: pycolmap.Reconstruction,
    similarity: Similarity,
    reference_extent: float,
    exact: bool,
) -> PoseErrors:
    """Pose errors of ``model`` after ``similarity``, over the images that have a pose in both
    models."""
    centers, rotations, reference_centers, reference_rotations = common_poses(model, reference)
    distances = np.linalg.norm(similarity(centers) - reference_centers, axis=1)  # [N]
    angles = rotation_angles(
        transformed_rotations(similarity, rotations), reference_rotations
    )  # [N]
    rmse = float(np.sqrt(np.mean(distances**2)))
    return PoseErrors(
        num_images=len(distances),
        exact=exact,
        center_rmse=rmse,
        center_mean=float(distances.mean()),
        center_max=float(distances.max()),
        center_rmse_relative=rmse / reference_extent if reference_extent > 0 else None,
        rotation_mean_deg=float(angles.mean()),
        rotation_max_deg=float(angles.max()),
    )


def make_report(
    init: str,
    poses: str,
    capture: Capture,
    model: pycolmap.Reconstruction,
    scale_to_reference: float | None,
    packages: Sequence[str],
    warnings: Sequence[str] = (),
    **further: Any,
) -> InitReport:
    """The report on ``model``, with the installed versions of ``packages`` and ``further`` fields
    of `InitReport`."""
    placed = set(poses_by_name(model))
    observed = any(point.track.length() > 0 for point in model.points3D.values())
    report = InitReport(
        init=init,
        poses=poses,
        num_images=len(capture.image_names),
        num_registered=len(placed),
        unregistered=tuple(name for name in capture.image_names if name not in placed),
        num_points=model.num_points3D(),
        mean_reprojection_error=model.compute_mean_reprojection_error() if observed else None,
        mean_track_length=model.compute_mean_track_length() if observed else None,
        focal_lengths=tuple(
            camera.mean_focal_length() for _, camera in sorted(model.cameras.items())
        ),
        gauge=measure_gauge(training_extent(model, capture), scale_to_reference),
        versions={package: metadata.version(package) for package in packages},
        **further,
    )
    return replace(report, warnings=(*warnings, *find_warnings(report, model)))


def write_result(model: pycolmap.Reconstruction, report: InitReport, output_dir: Path) -> None:
    """Write the model, the report and the picture where `gsbench.init.base.Initializer` promises
    them."""
    save_reconstruction(model, output_dir / MODEL_FOLDER)
    title = (
        f"{report.init}, {report.poses} poses: {report.num_points:,} points, "
        f"{report.num_registered} cameras"
    )
    draw_cloud(model, output_dir / PICTURE_FILE, f"{title}, from above")
    (output_dir / REPORT_FILE).write_text(json.dumps(report.to_dict(), indent=2) + "\n")


def find_warnings(report: InitReport, model: pycolmap.Reconstruction) -> tuple[str, ...]:
    """List the reasons to doubt a model, one line each. A model can be wrong although all its
    images have poses."""
    warnings = []
    if report.num_registered < REGISTERED_SHARE * report.num_images:
        missing = ", ".join(report.unregistered[:5]) + (
            " …" if len(report.unregistered) > 5 else ""
        )
        warnings.append(
            f"only {report.num_registered} of {report.num_images} images have a pose (missing: "
            f"{missing}): "
            "the other photos are not used; more overlap or texture would help"
        )
    if report.num_points < FEW_POINTS:
        warnings.append(f"only {report.num_points} points: training starts from next to nothing")
    error = report.mean_reprojection_error
    if error is not None and error > REPROJECTION_WARNING_PX:
        warnings.append(
            f"mean reprojection error {error:.2f} px is large: the cameras or the matches are "
            "probably wrong"
        )
    poses = report.pose_errors
    if poses is not None:
        truth = "true" if poses.exact else "reference"
        if poses.rotation_mean_deg > ROTATION_WARNING_DEG:
            warnings.append(
                f"the cameras are turned {poses.rotation_mean_deg:.1f} degrees against the "
                f"{truth} ones on average: "
                "the model is wrong although its images are placed (views at most 7.5 degrees "
                "apart are safe)"
            )
        if poses.center_rmse_relative is not None and poses.center_rmse_relative > CENTER_WARNING:
            warnings.append(
                f"the cameras are {poses.center_rmse_relative:.1%} of the scene extent away from "
                f"the {truth} ones"
            )
    for camera in model.cameras.values():
        view = 2 * math.degrees(
            math.atan(max(camera.width, camera.height) / (2 * camera.mean_focal_length()))
        )
        if not FIELD_OF_VIEW_DEG[0] < view < FIELD_OF_VIEW_DEG[1]:
            warnings.append(
                f"estimated focal length {camera.mean_focal_length():.0f} px (field of view "
                f"{view:.0f} degrees) is "
                "implausible: give init.focal_length in px"
            )
    return tuple(warnings)
