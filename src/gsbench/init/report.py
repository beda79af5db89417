"""The report on a model: its content, and reasons to doubt it."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pycolmap

from gsbench.gaussians.paper_values import VOLUME_THRESHOLD
from gsbench.init.base import MODEL_FOLDER, REPORT_FILE, Gauge, InitReport
from gsbench.init.colmap.models import training_extent
from gsbench.runs.trial_record import Oddity
from gsbench.scene.colmap import posed_images, save_model
from gsbench.scene.rules import Finding, inspect
from gsbench.scene.types import Capture


def make_report(
    init: str,
    poses: str,
    capture: Capture,
    model: pycolmap.Reconstruction,
    packages: Sequence[str] = (),
    warnings: Sequence[str] = (),
    scale_to_reference: float | None = None,
    **further: Any,
) -> InitReport:
    """The report on ``model``, with versions of its ``packages``, and further fields."""
    placed = posed_images(model)
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
        versions={
            package: metadata.version(package) for package in ("pycolmap", "numpy", *packages)
        },
        **further,
    )
    return replace(report, warnings=tuple(warnings), oddities=find_oddities(report, model, capture))


def measure_gauge(extent: float, scale_to_reference: float | None) -> Gauge:
    """Express the paper's V_th in the units of a model with the scene extent ``extent``."""
    # a sphere of volume V_th: 4/3 pi r^3 = V_th
    radius = (3 * VOLUME_THRESHOLD / (4 * math.pi)) ** (1 / 3)
    return Gauge(
        scene_extent=extent,
        scale_to_reference=scale_to_reference,
        volume_threshold=VOLUME_THRESHOLD,
        threshold_over_extent_cubed=VOLUME_THRESHOLD / extent**3 if extent > 0 else None,
        threshold_radius=radius,
        threshold_radius_over_extent=radius / extent if extent > 0 else None,
    )


def write_result(model: pycolmap.Reconstruction, report: InitReport, output_dir: Path) -> None:
    """Write model and report where `gsbench.init.base.Initializer` promises them."""
    save_model(model, output_dir / MODEL_FOLDER)
    (output_dir / REPORT_FILE).write_text(json.dumps(report.to_dict(), indent=2) + "\n")


def find_oddities(
    report: InitReport, model: pycolmap.Reconstruction, capture: Capture
) -> tuple[Oddity, ...]:
    """The reasons to doubt a model, logged: it can be wrong although all images have poses."""
    errors, fields = report.pose_errors, []
    for camera in model.cameras.values():
        focal, longest = camera.mean_focal_length(), max(camera.width, camera.height)
        view = 2 * math.degrees(math.atan(longest / (2 * focal)))
        fields.append(Finding(view, (), {"focal": focal}))
    facts = SimpleNamespace(
        **vars(report),
        placed_share=report.num_registered / report.num_images,
        truth="true" if errors is not None and errors.exact else "reference",
        rotation_error=None if errors is None else errors.rotation_mean_deg,
        center_error=None if errors is None else errors.center_rmse_relative,
        fields_of_view=fields,
    )
    return inspect("model", facts, f"scene {capture.name}: {report.init}", capture.accept)
