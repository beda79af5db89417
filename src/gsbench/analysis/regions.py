"""Regions in which an arm's renders have less error than the baseline's, beyond training noise.

A test view is cut into regions of 32 px. The observations of a region are the paired differences of
its PSNR, one for each seed. With three seeds a variance has two degrees of freedom, so that of a
region is shrunk towards that of the scene's regions: the moderated t of Smyth 2004
("Linear models and empirical Bayes methods for assessing differential expression in microarray
experiments", Stat. Appl. Genet. Mol. Biol. 3(1), sections 4 to 6).

All regions of a training share what went better or worse in it as a whole, and regions of one view
what did in that view. Shrinking assumes that regions are independent; it would then be sure of such
a shift after three seeds. So what scene and view have in common is a variance of its own, with the
degrees of freedom that few seeds give.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from gsbench.errors import InputError

SIDE = 32  # px
FEWEST_SEEDS = 3
FALSE_DISCOVERY_RATE = 0.05
ROUNDING = (
    1 / 12
)  # levels²: what rounding to 8 bits adds; keeps the PSNR of a perfect region finite

Array = NDArray[np.float64]


def region_errors(render: NDArray[Any], truth: NDArray[Any]) -> Array:
    """The mean squared error [R, C] in the regions of two 8-bit images [H, W, 3], in levels².

    Regions at the right and lower border are smaller if 32 does not divide the sides; narrower
    than half a region, they belong to their neighbour.
    """
    # whole numbers, since reports read hundreds of pictures
    squared = (render.astype(np.int32) - truth) ** 2
    error = squared.sum(axis=-1) / squared.shape[-1]  # [H, W]
    starts = [np.arange(max(1, round(size / SIDE))) * SIDE for size in error.shape]
    sums, counts = error, np.ones_like(error)
    for axis, first in enumerate(starts):
        sums, counts = (np.add.reduceat(each, first, axis) for each in (sums, counts))
    return sums / counts


def prior_of(variances: Array, degrees: int) -> tuple[float, float]:
    """The prior's degrees of freedom d0 and variance s0², from the variances [N] of regions.

    They match mean and variance of the logarithms, as in section 6.2 of Smyth 2004. d0 is infinite
    if the variances differ no more than samples of equal ones do. Unlike there, the variance of the
    logarithms is raised by two of its standard errors: with a few hundred regions d0 is uncertain,
    and one that is too large lights regions without a cause (10 % of reports, not 5).
    """
    from scipy.optimize import brentq  # here, since it is slow to import

    logs = np.log(variances[(variances > 0) & np.isfinite(variances)])
    if len(logs) < 2:
        return 0.0, float(variances.mean())
    excess = logs - special.digamma(degrees / 2) + np.log(degrees / 2)
    squares = (excess - excess.mean()) ** 2
    uncertain = 2 * float(squares.std(ddof=1)) / np.sqrt(len(squares))
    spread = float(excess.var(ddof=1)) + uncertain - float(special.polygamma(1, degrees / 2))
    if spread <= 0:
        return np.inf, float(np.exp(excess.mean()))
    # the x with trigamma(x) = spread (appendix); a smaller spread gives nearly infinite degrees
    half = float(brentq(lambda x: special.polygamma(1, x) - max(spread, 1e-8), 1e-6, 1e9))
    return 2 * half, float(np.exp(excess.mean() + special.digamma(half) - np.log(half)))


def region_psnr(error: Array) -> Array:
    """The PSNR in dB of regions with the mean squared ``error`` in levels²."""
    return -10 * np.log10((error + ROUNDING) / 255**2)


@dataclass(frozen=True)
class SceneRegions:
    """The regions of a scene's test views: differences, the baseline's noise, and p.

    ``change`` holds for each view the mean difference in dB [R, C] (arm minus baseline, positive is
    better), ``p`` its two-sided p, and ``spread`` the standard deviation in dB [R, C] over seeds of
    the baseline alone.
    """

    change: Mapping[str, Array]
    p: Mapping[str, Array]
    spread: Mapping[str, Array]


def compare_regions(
    arm: Sequence[Mapping[str, Array]], baseline: Sequence[Mapping[str, Array]]
) -> SceneRegions:
    """The comparison of one scene, from the region errors by view of each seed's pair.

    Raises InputError for fewer than three seeds, and if trials have other views or sizes.
    """
    seeds = len(arm)
    if seeds < FEWEST_SEEDS or len(baseline) != seeds:
        raise InputError(f"a map of regions needs {FEWEST_SEEDS} pairs of seeds, got {seeds}")
    views = list(arm[0])
    shapes = [arm[0][view].shape for view in views]
    for trial in (*arm, *baseline):
        if list(trial) != views or [trial[view].shape for view in views] != shapes:
            raise InputError("regions of trials with other test views cannot be compared")
    ours, theirs = (
        [region_psnr(np.stack([trial[view] for trial in trials])) for view in views]
        for trials in (arm, baseline)
    )
    differences = [one - other for one, other in zip(ours, theirs, strict=True)]  # [K, R, C] each
    rows = [each.reshape(seeds, -1) for each in differences]  # [K, N] each
    p = _p_values(rows)
    spread = {view: each.std(axis=0, ddof=1) for view, each in zip(views, theirs, strict=True)}
    named = list(zip(views, shapes, strict=True))
    return SceneRegions(
        {view: each.mean(axis=0) for view, each in zip(views, differences, strict=True)},
        {view: own.reshape(shape) for (view, shape), own in zip(named, p, strict=True)},
        spread,
    )


def _p_values(rows: Sequence[Array]) -> list[Array]:
    """The two-sided p of each region's mean over seeds, for views of [K, N] differences."""
    seeds = len(rows[0])
    degrees = seeds - 1
    scene = np.concatenate(rows, axis=1).mean(axis=1)  # [K] what all regions of a pair share
    views = [row.mean(axis=1) - scene for row in rows]  # [K] each: what those of a view share
    own = [
        (row - (scene + view)[:, None]).var(axis=0, ddof=1)
        for row, view in zip(rows, views, strict=True)
    ]  # [N] each
    prior_degrees, prior = prior_of(np.concatenate(own), degrees)
    weight = 1.0 if np.isinf(prior_degrees) else prior_degrees / (degrees + prior_degrees)
    found = []
    for row, view, variances in zip(rows, views, own, strict=True):
        shrunk = (1 - weight) * variances + weight * prior
        shared = float(view.var(ddof=1)), float(scene.var(ddof=1))
        variance = shrunk + sum(shared)
        # Welch and Satterthwaite give the degrees of freedom of a sum of variances. They are no
        # more than those of the region: real noise has longer tails than the normal, and with more
        # degrees two reports of five lit a region in trainings of one arm.
        both = shrunk**2 / (degrees + prior_degrees) + sum(one**2 for one in shared) / degrees
        with np.errstate(divide="ignore", invalid="ignore"):
            effective = np.minimum(np.minimum(variance**2 / both, degrees + prior_degrees), 1e9)
            size = np.abs(row.mean(axis=0)) / np.sqrt(variance / seeds)
        # without any spread and difference nothing was seen
        found.append(np.where(np.isnan(size), 1.0, 2 * special.stdtr(effective, -size)))
    return found


def discoveries(p: Sequence[Array], rate: float = FALSE_DISCOVERY_RATE) -> list[NDArray[np.bool_]]:
    """The p of a report that are discoveries, by Benjamini and Hochberg (1995) in one family."""
    flat = np.concatenate([each.ravel() for each in p])
    ordered = np.sort(flat)
    passes = np.flatnonzero(ordered <= rate * np.arange(1, len(flat) + 1) / len(flat))
    limit = ordered[passes[-1]] if len(passes) else -1.0
    return [each <= limit for each in p]
