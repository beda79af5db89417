"""Operations on COLMAP models. They call native code that can abort: run them isolated.

pycolmap's own estimates of the alignment to a reference equal these to rounding, but have no result
for cameras in a plane through the origin (such as a ring at height 0), and the robust one wants a
tolerance in units of the model.
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from gsbench.errors import InputError
from gsbench.init.base import PoseErrors, TrainingPoints
from gsbench.scene.colmap import MIN_TRACK, posed_images
from gsbench.scene.types import Array, Capture, extent_of_centers

TRIALS = 500  # random triples of cameras
# 2.5 sigma, as in least median of squares; the median absolute deviation times 1.4826 estimates
# sigma.
INLIER_FACTOR = 2.5 * 1.4826
# second over first singular value of the centres: below it they count as collinear
COLLINEAR_RATIO = 1e-2

# centres [N, 3] and rotations [N, 3, 3] (world to camera) of a model's cameras, and the reference's
CommonPoses = tuple[Array, Array, Array, Array]


def training_centers(model: pycolmap.Reconstruction, capture: Capture) -> Array:
    """The centres [V, 3] of the training images with a pose in the model."""
    images = posed_images(model)
    return np.array(
        [images[name].projection_center() for name in capture.train_names if name in images]
    )


def training_extent(model: pycolmap.Reconstruction, capture: Capture) -> float:
    """3DGS's ``cameras_extent`` of the training images with a pose in the model, else 0."""
    centers = training_centers(model, capture)
    return extent_of_centers(centers) if len(centers) else 0.0


def keep_training_points(
    model: pycolmap.Reconstruction, names: Collection[str], images: Path
) -> TrainingPoints:
    """Keep the points that at least two of the images ``names`` see, with only those observations.

    Positions do not change. Colours are read again, from the photographs in the folder ``images``.
    """
    before = model.num_points3D()
    kept = set(names)
    for name, image in posed_images(model).items():
        for index, seen in enumerate(image.points2D if name not in kept else ()):
            if seen.has_point3D():
                model.delete_observation(image.image_id, index)  # and its point, if one is left
    for point_id, point in list(model.points3D.items()):
        # an image may see a point twice
        if len({element.image_id for element in point.track.elements}) < MIN_TRACK:
            model.delete_point3D(point_id)
    model.extract_colors_for_all_images(images)
    count = model.num_points3D()
    if count == 0:
        raise InputError(
            "init.points_from=train: no point is left that two training views see; take "
            "init.points_from=all, or hold out fewer views"
        )
    return TrainingPoints("train", count, before, 1 - count / before if before else 0.0)


# ---- alignment to a reference


def align(
    model: pycolmap.Reconstruction,
    reference: pycolmap.Reconstruction | None,
    capture: Capture,
    exact: bool,
    move: bool,
) -> dict[str, Any]:
    """Compare estimated poses with the reference; ``move`` the model into the reference's gauge.

    ``exact`` says that the reference is the truth. Returns arguments of
    `gsbench.init.report.make_report`.
    """
    if reference is None:
        return {}
    poses = common_poses(model, reference)
    similarity = align_poses(*poses)
    if similarity is None:
        few = "too few common cameras with the reference: poses are neither aligned nor compared"
        return {"warnings": [few]}
    errors = compare_poses(poses, similarity, training_extent(reference, capture), exact)
    if move:
        model.transform(similarity)
    scale = 1.0 if move else float(similarity.scale)
    return {"scale_to_reference": scale, "pose_errors": errors}


def common_poses(model: pycolmap.Reconstruction, reference: pycolmap.Reconstruction) -> CommonPoses:
    """The poses of the images that have one in both models, by their names."""
    own, others = posed_images(model), posed_images(reference)
    names = sorted(own.keys() & others.keys())
    centers, rotations, other_centers, other_rotations = (
        np.array([read(images[name]) for name in names])
        for images in (own, others)
        for read in (
            pycolmap.Image.projection_center,
            lambda image: image.cam_from_world().rotation.matrix(),
        )
    )
    return centers, rotations, other_centers, other_rotations


def align_poses(
    source: Array, source_rotations: Array, target: Array, target_rotations: Array
) -> pycolmap.Sim3d | None:
    """The similarity from one model's cameras to another's, robust to wrong cameras.

    It is fitted to the centres, by the least median of squared residuals over random triples, then
    by least squares over the inliers. Collinear centres leave the rotation about their line open;
    then the rotation comes from the cameras' orientations. None for less than three cameras, and if
    the centres of one model coincide.
    """
    if len(source) < 3:
        return None
    spreads = np.array([_spread(source), _spread(target)])  # [2, 3]
    if spreads[:, 0].min() <= 1e-12:
        return None
    if (spreads[:, 1] / spreads[:, 0]).min() < COLLINEAR_RATIO:
        turns = Rotation.from_matrix(target_rotations).inv() * Rotation.from_matrix(
            source_rotations
        )
        scale = float(np.divide(*np.linalg.norm(spreads[::-1], axis=1)))
        return _with_means(scale, turns.mean(), source, target)  # the chordal mean
    generator = np.random.default_rng(0)  # a fixed seed: the triples only guide the search
    best = _misses(fit_similarity(source, target), source, target)  # [N]
    for _ in range(TRIALS):
        triple = generator.choice(len(source), 3, replace=False)
        spreads_of_three = _spread(source[triple]), _spread(target[triple])
        if all(spread[1] > COLLINEAR_RATIO * spread[0] for spread in spreads_of_three):
            fitted = fit_similarity(source[triple], target[triple])
            best = min(best, _misses(fitted, source, target), key=np.median)
    # At least three cameras are inliers: residuals up to the median and, of three cameras, the
    # third one's too, since a least-squares fit leaves residuals that add up to 0.
    inliers = best <= max(INLIER_FACTOR * float(np.median(best)), 1e-9 * spreads[1, 0])
    return fit_similarity(source[inliers], target[inliers])


def fit_similarity(source: Array, target: Array) -> pycolmap.Sim3d:
    """The least-squares similarity of ``source`` to ``target`` [N, 3] (Umeyama 1991, eq. 40-42)."""
    offsets, target_offsets = source - source.mean(axis=0), target - target.mean(axis=0)
    turn, _ = Rotation.align_vectors(target_offsets, offsets)
    scale = float(np.sum(target_offsets * turn.apply(offsets)) / np.sum(offsets**2))
    return _with_means(scale, turn, source, target)


def _with_means(scale: float, turn: Rotation, source: Array, target: Array) -> pycolmap.Sim3d:
    """The similarity that moves the mean of ``source`` to that of ``target``."""
    shift = target.mean(axis=0) - scale * turn.apply(source.mean(axis=0))
    return pycolmap.Sim3d(scale, pycolmap.Rotation3d(turn.as_matrix()), shift)


def _misses(similarity: pycolmap.Sim3d, source: Array, target: Array) -> Array:
    """Distances [N] of the transformed ``source`` from ``target`` [N, 3]."""
    return np.linalg.norm(similarity * source - target, axis=1)


def _spread(centers: Array) -> Array:
    """The singular values [3] of centres around their mean, largest first."""
    return np.linalg.svd(centers - centers.mean(axis=0), compute_uv=False)


def compare_poses(
    poses: CommonPoses, similarity: pycolmap.Sim3d, reference_extent: float, exact: bool
) -> PoseErrors:
    """Errors of a model's poses after ``similarity``; the reference's extent is in its units."""
    centers, rotations, true_centers, true_rotations = poses
    distances = _misses(similarity, centers, true_centers)  # [N]
    turned = Rotation.from_matrix(rotations @ similarity.rotation.matrix().T)
    angles = np.degrees((turned * Rotation.from_matrix(true_rotations).inv()).magnitude())  # [N]
    rmse = float(np.sqrt(np.mean(distances**2)))
    return PoseErrors(
        num_images=len(distances),
        exact=exact,
        center_rmse=rmse,
        center_rmse_relative=rmse / reference_extent if reference_extent > 0 else None,
        rotation_mean_deg=float(angles.mean()),
        rotation_max_deg=float(angles.max()),
    )
