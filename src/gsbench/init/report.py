"""The report on a model: its content, and reasons to doubt it."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import Any

import pycolmap

from gsbench.init.base import (
    FIELD_OF_VIEW_DEG,
    MODEL_FOLDER,
    REGISTERED_SHARE,
    REPORT_FILE,
    InitReport,
)
from gsbench.init.colmap.alignment import measure_gauge, training_extent
from gsbench.init.colmap.reconstruct import poses_by_name
from gsbench.scene.colmap import save_model
from gsbench.scene.types import Capture

# correct models stay below 0.5; wrong ones that register every image reach 20 and more
ROTATION_WARNING_DEG = 2.0
CENTER_WARNING = 0.05  # of the reference's scene extent
# correct models stay below 0.7 px with SIFT, below 1.2 px with learned features
REPROJECTION_WARNING_PX = 1.5
FEW_POINTS = 100


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
    """The report on ``model``, with versions of ``packages`` and further fields."""
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
    """Write model and report where `gsbench.init.base.Initializer` promises them."""
    save_model(model, output_dir / MODEL_FOLDER)
    (output_dir / REPORT_FILE).write_text(json.dumps(report.to_dict(), indent=2) + "\n")


def find_warnings(report: InitReport, model: pycolmap.Reconstruction) -> tuple[str, ...]:
    """List the reasons to doubt a model: it can be wrong although all its images have poses."""
    warnings = []
    if report.num_registered < REGISTERED_SHARE * report.num_images:
        missing = ", ".join(report.unregistered[:5])
        missing += " …" if len(report.unregistered) > 5 else ""
        warnings.append(
            f"only {report.num_registered} of {report.num_images} images have a pose (missing: "
            f"{missing}): the other photos are not used; more overlap or texture would help"
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
                f"the cameras are turned {poses.rotation_mean_deg:.1f} degrees against the {truth} "
                "ones on average: the model is wrong although its images are placed (views at most "
                "7.5 degrees apart are safe)"
            )
        if poses.center_rmse_relative is not None and poses.center_rmse_relative > CENTER_WARNING:
            warnings.append(
                f"the cameras are {poses.center_rmse_relative:.1%} of the scene extent away from "
                f"the {truth} ones"
            )
    for camera in model.cameras.values():
        longest = max(camera.width, camera.height)
        view = 2 * math.degrees(math.atan(longest / (2 * camera.mean_focal_length())))
        if not FIELD_OF_VIEW_DEG[0] < view < FIELD_OF_VIEW_DEG[1]:
            warnings.append(
                f"estimated focal length {camera.mean_focal_length():.0f} px (field of view "
                f"{view:.0f} degrees) is implausible: give init.focal_length in px"
            )
    return tuple(warnings)
