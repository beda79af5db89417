"""Similarity transforms between two sets of camera poses."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsbench.scene.types import Array

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


def fit_similarity(source: Array, target: Array) -> Similarity:
    """The least-squares similarity of ``source`` to ``target`` [N, 3] (Umeyama 1991, eq. 40-42)."""
    offsets, target_offsets = _centered(source), _centered(target)
    u, singular_values, vt = np.linalg.svd(target_offsets.T @ offsets / len(source))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = u @ np.diag(signs) @ vt
    scale = float(singular_values @ signs / np.mean(np.sum(offsets**2, axis=1)))
    return _with_means(scale, rotation, source, target)


def _with_means(scale: float, rotation: Array, source: Array, target: Array) -> Similarity:
    """The similarity that moves the mean of ``source`` to that of ``target``."""
    return Similarity(scale, rotation, target.mean(axis=0) - scale * rotation @ source.mean(axis=0))


def _centered(points: Array) -> Array:
    return points - points.mean(axis=0)


def _spread(centers: Array) -> NDArray[np.floating]:
    """The singular values [3] of centres around their mean, largest first."""
    return np.linalg.svd(_centered(centers), compute_uv=False)


def _distances(fit: Similarity, source: Array, target: Array) -> Array:
    distances: Array = np.linalg.norm(fit(source) - target, axis=1)  # [N]
    return distances


def align_poses(
    source_centers: Array, source_rotations: Array, target_centers: Array, target_rotations: Array
) -> Similarity:
    """The similarity from one model's cameras to another's, robust to wrong cameras.

    Centres are [N, 3] and rotations (world to camera) [N, 3, 3], in the same order of cameras, N >=
    3. The similarity is fitted to the centres, by the least median of squared residuals over random
    triples, then by least squares over the inliers. Collinear centres leave the rotation about
    their line open; then the rotation comes from the cameras' orientations. Raises ``ValueError``
    if the centres of one model coincide.
    """
    if len(source_centers) < 3:
        raise ValueError(f"a similarity needs at least 3 common cameras, got {len(source_centers)}")
    spreads = [_spread(centers) for centers in (source_centers, target_centers)]
    if min(spread[0] for spread in spreads) <= 1e-12:
        raise ValueError("a similarity needs cameras at different places")
    if min(spread[1] / spread[0] for spread in spreads) < COLLINEAR_RATIO:
        return _fit_with_orientations(
            source_centers, source_rotations, target_centers, target_rotations
        )
    best = _least_median_fit(source_centers, target_centers)
    residuals = _distances(best, source_centers, target_centers)
    inliers = residuals <= max(
        INLIER_FACTOR * float(np.median(residuals)), 1e-9 * float(spreads[1][0])
    )
    # At least three cameras are inliers: residuals up to the median and, of three cameras, the
    # third one's too, since a least-squares fit leaves residuals that add up to 0.
    return fit_similarity(source_centers[inliers], target_centers[inliers])


def rotation_angles(first: Array, second: Array) -> Array:
    """Angles [N] in degrees between rotations [N, 3, 3]."""
    # The chord |A - B| = 2 sqrt(2) sin(angle / 2) is accurate near an angle of 0, the trace formula
    # is not.
    chords = np.linalg.norm(first - second, axis=(1, 2))  # Frobenius norm
    return np.degrees(2 * np.arcsin(np.clip(chords / (2 * np.sqrt(2)), 0.0, 1.0)))


def transformed_rotations(similarity: Similarity, rotations: Array) -> Array:
    """World-to-camera rotations [N, 3, 3] after ``similarity`` has transformed the world."""
    return rotations @ similarity.rotation.T


def _least_median_fit(source: Array, target: Array) -> Similarity:
    generator = np.random.default_rng(0)  # a fixed seed: the triples only guide the search
    best = fit_similarity(source, target)
    best_median = np.median(_distances(best, source, target))
    for _ in range(RANSAC_TRIALS):
        triple = generator.choice(len(source), 3, replace=False)
        spread = _spread(source[triple])
        if spread[1] <= COLLINEAR_RATIO * spread[0]:
            continue
        candidate = fit_similarity(source[triple], target[triple])
        median = np.median(_distances(candidate, source, target))
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
