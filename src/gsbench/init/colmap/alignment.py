"""Alignment of a model to the reference, pose errors, and the volume threshold in its units."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from gsbench.gaussians.paper_values import VOLUME_THRESHOLD
from gsbench.init.base import Gauge, PoseErrors
from gsbench.init.colmap.reconstruct import common_poses, poses_by_name
from gsbench.init.colmap.similarity import (
    Similarity,
    align_poses,
    rotation_angles,
    transformed_rotations,
)
from gsbench.scene.colmap import save_model
from gsbench.scene.types import Array, Capture, extent_of_centers


@dataclass(frozen=True)
class Alignment:
    """The comparison of a model with the reference; fields are None if there was none."""

    scale_to_reference: float | None = None  # None without a reference
    own_gauge: Gauge | None = None
    pose_errors: PoseErrors | None = None
    warnings: tuple[str, ...] = ()


def align(
    model: pycolmap.Reconstruction,
    reference: pycolmap.Reconstruction | None,
    capture: Capture,
    exact: bool,
    own_gauge: Path | None,
) -> Alignment:
    """Compare estimated poses with the reference, and move the model into the reference's gauge.

    ``own_gauge`` is the folder for a copy of the model before it is moved; if it is None, the model
    is not moved. ``exact`` says that the reference is the truth.
    """
    if reference is None:
        return Alignment()
    similarity = similarity_to(model, reference)
    if similarity is None:
        few = "too few common cameras with the reference: poses are neither aligned nor compared"
        return Alignment(warnings=(few,))
    extent = training_extent(reference, capture)
    errors = compare_poses(model, reference, similarity, extent, exact)
    if own_gauge is None:
        return Alignment(similarity.scale, pose_errors=errors)
    gauge = measure_gauge(training_extent(model, capture), similarity.scale)
    save_model(model, own_gauge)
    rotation = pycolmap.Rotation3d(similarity.rotation)
    model.transform(pycolmap.Sim3d(similarity.scale, rotation, similarity.translation))
    return Alignment(1.0, gauge, errors)


def similarity_to(
    model: pycolmap.Reconstruction, reference: pycolmap.Reconstruction
) -> Similarity | None:
    """The similarity from ``model`` to ``reference``; None for too few common cameras."""
    try:
        return align_poses(*common_poses(model, reference))
    except ValueError:
        return None


def training_extent(model: pycolmap.Reconstruction, capture: Capture) -> float:
    """3DGS's ``cameras_extent`` of the training images with a pose in the model, else 0."""
    centers = training_centers(model, capture)
    return extent_of_centers(centers) if len(centers) else 0.0


def training_centers(model: pycolmap.Reconstruction, capture: Capture) -> Array:
    """The centres [V, 3] of the training images with a pose in the model."""
    poses = poses_by_name(model)
    return np.array([poses[name][0] for name in capture.train_names if name in poses])


def measure_gauge(extent: float, scale_to_reference: float | None) -> Gauge:
    """Express the paper's V_th in the units of a model with the scene extent ``extent``."""
    in_reference = None
    if scale_to_reference is not None:
        in_reference = VOLUME_THRESHOLD * scale_to_reference**3
    # a sphere of volume V_th: 4/3 pi r^3 = V_th
    radius = (3 * VOLUME_THRESHOLD / (4 * math.pi)) ** (1 / 3)
    return Gauge(
        scene_extent=extent,
        scale_to_reference=scale_to_reference,
        volume_threshold=VOLUME_THRESHOLD,
        threshold_over_extent_cubed=VOLUME_THRESHOLD / extent**3 if extent > 0 else None,
        threshold_radius=radius,
        threshold_radius_over_extent=radius / extent if extent > 0 else None,
        threshold_in_reference=in_reference,
    )


def compare_poses(
    model: pycolmap.Reconstruction,
    reference: pycolmap.Reconstruction,
    similarity: Similarity,
    reference_extent: float,
    exact: bool,
) -> PoseErrors:
    """Pose errors of ``model`` after ``similarity``, over the images with a pose in both models."""
    centers, rotations, reference_centers, reference_rotations = common_poses(model, reference)
    distances = np.linalg.norm(similarity(centers) - reference_centers, axis=1)  # [N]
    turned = transformed_rotations(similarity, rotations)
    angles = rotation_angles(turned, reference_rotations)  # [N]
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
