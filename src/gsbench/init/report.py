"""The gauge report: what a model holds, how far its poses are from the reference, and what V_th means in its units."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from gsbench.gaussians.paper_values import VOLUME_THRESHOLD
from gsbench.init.base import MODEL_FOLDER, PICTURE_FILE, REPORT_FILE, Gauge, InitReport, PoseErrors, TrainingPoints
from gsbench.init.colmap.alignment import Similarity, rotation_angles, transformed_rotations
from gsbench.init.colmap.reconstruct import common_poses, poses_by_name, save_reconstruction
from gsbench.init.plot import draw_cloud
from gsbench.scene.types import EXTENT_MARGIN, Capture

REGISTERED_SHARE = 0.9  # below this share of the images is a warning
ROTATION_WARNING_DEG = 2.0  # sound models stay below 0.5; wrong ones that register every image reach 20 and more
CENTER_WARNING = 0.05  # of the reference's scene extent
REPROJECTION_WARNING_PX = 1.5  # sound models of SIFT are below 0.7 px, of learned features below 1.2 px
FIELD_OF_VIEW_DEG = (5.0, 150.0)  # of the longest side; an estimate outside of it is nonsense
FEW_POINTS = 100


def training_extent(model: pycolmap.Reconstruction, capture: Capture) -> float:
    """3DGS's ``cameras_extent`` of the capture's training images that the model places; 0 where it places none."""
    poses = poses_by_name(model)
    centers = np.array([poses[name][0] for name in capture.train_names if name in poses]).reshape(-1, 3)
    if len(centers) == 0:
        return 0.0
    return float(EXTENT_MARGIN * np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())


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
        threshold_in_reference=None if scale_to_reference is None else VOLUME_THRESHOLD * scale_to_reference**3,
    )


def compare_poses(
    model: pycolmap.Reconstruction,
    reference: pycolmap.Reconstruction,
    similarity: Similarity,
    reference_extent: float,
    exact: bool,
) -> PoseErrors:
    """Errors of the poses of ``model``, moved by ``similarity``, over the images that both place."""
    centers, rotations, reference_centers, reference_rotations = common_poses(model, reference)
    distances = np.linalg.norm(similarity(centers) - reference_centers, axis=1)  # [N]
    angles = rotation_angles(transformed_rotations(similarity, rotations), reference_rotations)  # [N]
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
    *,
    settings: Mapping[str, Any],
    seconds: Mapping[str, float],
    packages: Sequence[str],
    own_gauge: Gauge | None = None,
    pose_errors: PoseErrors | None = None,
    counts: Mapping[str, int] | None = None,
    mapped_by: str | None = None,
    warnings: Sequence[str] = (),
    training_points: TrainingPoints | None = None,
) -> InitReport:
    """The report on ``model`` as it is written; ``packages`` are those whose installed versions it states."""
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
        focal_lengths=tuple(camera.mean_focal_length() for _, camera in sorted(model.cameras.items())),
        gauge=measure_gauge(training_extent(model, capture), scale_to_reference),
        seconds=seconds,
        settings=settings,
        versions={package: metadata.version(package) for package in packages},
        own_gauge=own_gauge,
        pose_errors=pose_errors,
        counts=counts or {},
        mapped_by=mapped_by,
        training_points=training_points,
    )
    return replace(report, warnings=(*warnings, *find_warnings(report, model)))


def write_result(model: pycolmap.Reconstruction, report: InitReport, output_dir: Path) -> None:
    """Write the model, the report and the picture where `gsbench.init.base.Initializer` promises them."""
    save_reconstruction(model, output_dir / MODEL_FOLDER)
    title = f"{report.init}, {report.poses} poses: {report.num_points:,} points, {report.num_registered} cameras"
    draw_cloud(model, output_dir / PICTURE_FILE, f"{title}, from above")
    report.write(output_dir / REPORT_FILE)


def find_warnings(report: InitReport, model: pycolmap.Reconstruction) -> tuple[str, ...]:
    """List the reasons to doubt a model, each in one line; that all images are placed is no proof."""
    found = []
    if report.num_registered < REGISTERED_SHARE * report.num_images:
        missing = ", ".join(report.unregistered[:5]) + (" …" if len(report.unregistered) > 5 else "")
        found.append(
            f"only {report.num_registered} of {report.num_images} images have a pose (missing: {missing}): "
            "the other photos are not used; more overlap or texture would help"
        )
    if report.num_points < FEW_POINTS:
        found.append(f"only {report.num_points} points: training starts from next to nothing")
    error = report.mean_reprojection_error
    if error is not None and error > REPROJECTION_WARNING_PX:
        found.append(f"mean reprojection error {error:.2f} px is large: the cameras or the matches are probably wrong")
    poses = report.pose_errors
    if poses is not None:
        truth = "true" if poses.exact else "reference"
        if poses.rotation_mean_deg > ROTATION_WARNING_DEG:
            found.append(
                f"the cameras are turned {poses.rotation_mean_deg:.1f} degrees against the {truth} ones on average: "
                "the model is wrong although its images are placed (views at most 7.5 degrees apart are safe)"
            )
        if poses.center_rmse_relative is not None and poses.center_rmse_relative > CENTER_WARNING:
            found.append(
                f"the cameras are {poses.center_rmse_relative:.1%} of the scene extent away from the {truth} ones"
            )
    for camera in model.cameras.values():
        view = 2 * math.degrees(math.atan(max(camera.width, camera.height) / (2 * camera.mean_focal_length())))
        if not FIELD_OF_VIEW_DEG[0] < view < FIELD_OF_VIEW_DEG[1]:
            found.append(
                f"estimated focal length {camera.mean_focal_length():.0f} px (field of view {view:.0f} degrees) is "
                "implausible: give init.focal_length in px"
            )
    return tuple(found)
