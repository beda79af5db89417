"""Alignment of a model to the reference, pose errors, and the volume threshold in its units.

pycolmap's robust estimate of a similarity wants a tolerance in units of the model, and with a
quarter of wrong cameras it was off by a quarter in scale, and other in each run.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from gsbench.gaussians.paper_values import VOLUME_THRESHOLD
from gsbench.init.base import Gauge, PoseErrors
from gsbench.init.colmap.reconstruct import common_poses, poses_by_name
from gsbench.scene.colmap import save_model
from gsbench.scene.types import Array, Capture, extent_of_centers


def align(
    model: pycolmap.Reconstruction,
    reference: pycolmap.Reconstruction | None,
    capture: Capture,
    exact: bool,
    own_gauge: Path | None,
) -> dict[str, Any]:
    """Compare estimated poses with the reference, and move the model into the reference's gauge.

    ``own_gauge`` is the folder for a copy of the model before it is moved; if it is None, the model
    is not moved. ``exact`` says that the reference is the truth. Returns arguments of
    `gsbench.init.report.make_report`.
    """
    if reference is None:
        return {}
    similarity = align_poses(*common_poses(model, reference))
    if similarity is None:
        few = "too few common cameras with the reference: poses are neither aligned nor compared"
        return {"warnings": (few,)}
    extent = training_extent(reference, capture)
    errors = compare_poses(model, reference, similarity, extent, exact)
    if own_gauge is None:
        return {"scale_to_reference": similarity.scale, "pose_errors": errors}
    gauge = measure_gauge(training_extent(model, capture), similarity.scale)
    save_model(model, own_gauge)
    rotation = pycolmap.Rotation3d(similarity.rotation)
    model.transform(pycolmap.Sim3d(similarity.scale, rotation, similarity.translation))
    return {"scale_to_reference": 1.0, "own_gauge": gauge, "pose_errors": errors}


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
    distances = similarity.misses(centers, reference_centers)  # [N]
    angles = rotation_angles(rotations @ similarity.rotation.T, reference_rotations)  # [N]
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


RANSAC_TRIALS = 500
# 2.5 sigma, as in least median of squares; the median absolute deviation times 1.4826 estimates
# sigma.
INLIER_FACTOR = 2.5 * 1.4826
# second over first singular value of the centres: below it they count as collinear
COLLINEAR_RATIO = 1e-2


@dataclass(frozen=True, eq=False)
class Similarity:
    """``x_target = scale * rotation @ x_source + translation``."""

    scale: float
    rotation: Array  # [3, 3]
    translation: Array  # [3]

    def __call__(self, points: Array) -> Array:
        """Transform ``points`` [N, 3]."""
        return self.scale * points @ self.rotation.T + self.translation

    def misses(self, source: Array, target: Array) -> Array:
        """Distances [N] of the transformed ``source`` from ``target`` [N, 3]."""
        distances: Array = np.linalg.norm(self(source) - target, axis=1)
        return distances


def fit_similarity(source: Array, target: Array) -> Similarity:
    """The least-squares similarity of ``source`` to ``target`` [N, 3] (Umeyama 1991, eq. 40-42)."""
    offsets, target_offsets = _centered(source), _centered(target)
    u, singular_values, vt = np.linalg.svd(target_offsets.T @ offsets / len(source))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    scale = float(singular_values @ signs / np.mean(np.sum(offsets**2, axis=1)))
    return _with_means(scale, u @ np.diag(signs) @ vt, source, target)


def _with_means(scale: float, rotation: Array, source: Array, target: Array) -> Similarity:
    """The similarity that moves the mean of ``source`` to that of ``target``."""
    return Similarity(scale, rotation, target.mean(axis=0) - scale * rotation @ source.mean(axis=0))


def _centered(points: Array) -> Array:
    return points - points.mean(axis=0)


def _spread(centers: Array) -> NDArray[np.floating]:
    """The singular values [3] of centres around their mean, largest first."""
    return np.linalg.svd(_centered(centers), compute_uv=False)


def align_poses(
    source: Array, source_rotations: Array, target: Array, target_rotations: Array
) -> Similarity | None:
    """The similarity from one model's cameras to another's, robust to wrong cameras.

    Centres are [N, 3] and rotations (world to camera) [N, 3, 3], in the same order of cameras. The
    similarity is fitted to the centres, by the least median of squared residuals over random
    triples, then by least squares over the inliers. Collinear centres leave the rotation about
    their line open; then the rotation comes from the cameras' orientations. None for less than
    three cameras, and if the centres of one model coincide.
    """
    if len(source) < 3:
        return None
    spreads = np.array([_spread(source), _spread(target)])
    if spreads[:, 0].min() <= 1e-12:
        return None
    if (spreads[:, 1] / spreads[:, 0]).min() < COLLINEAR_RATIO:
        return _fit_with_orientations(source, source_rotations, target, target_rotations)
    misses = _least_median_fit(source, target).misses(source, target)
    inliers = misses <= max(INLIER_FACTOR * float(np.median(misses)), 1e-9 * spreads[1, 0])
    # At least three cameras are inliers: residuals up to the median and, of three cameras, the
    # third one's too, since a least-squares fit leaves residuals that add up to 0.
    return fit_similarity(source[inliers], target[inliers])


def rotation_angles(first: Array, second: Array) -> Array:
    """Angles [N] in degrees between rotations [N, 3, 3]."""
    # The chord |A - B| = 2 sqrt(2) sin(angle / 2) is accurate near an angle of 0, the trace formula
    # is not.
    chords = np.linalg.norm(first - second, axis=(1, 2))  # Frobenius norm
    return np.degrees(2 * np.arcsin(np.clip(chords / (2 * np.sqrt(2)), 0.0, 1.0)))


def _least_median_fit(source: Array, target: Array) -> Similarity:
    generator = np.random.default_rng(0)  # a fixed seed: the triples only guide the search
    best = fit_similarity(source, target)
    best_median = np.median(best.misses(source, target))
    for _ in range(RANSAC_TRIALS):
        triple = generator.choice(len(source), 3, replace=False)
        spread = _spread(source[triple])
        if spread[1] <= COLLINEAR_RATIO * spread[0]:
            continue
        candidate = fit_similarity(source[triple], target[triple])
        median = np.median(candidate.misses(source, target))
        if median < best_median:
            best, best_median = candidate, median
    return best


def _fit_with_orientations(
    source: Array, source_rotations: Array, target: Array, target_rotations: Array
) -> Similarity:
    """Fit the rotation to orientations (chordal mean), the rest to the centres."""
    u, _, vt = np.linalg.svd((np.swapaxes(target_rotations, 1, 2) @ source_rotations).sum(axis=0))
    rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    rotated = _centered(source) @ rotation.T
    scale = float(np.linalg.norm(_centered(target)) / np.linalg.norm(rotated))
    return _with_means(scale, rotation, source, target)
