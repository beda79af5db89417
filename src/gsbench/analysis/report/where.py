"""Maps of regions in which an arm's renders have less error than the baseline's, beyond noise.

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

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from gsbench.analysis.comparison import Answer
from gsbench.analysis.images import SIDE, jpeg_uri, read_truth, regions_of
from gsbench.analysis.pairs import pair_trials
from gsbench.analysis.results import Arm, TrialPair, TrialResult, group_by
from gsbench.errors import InputError

FEWEST_SEEDS = 3
FALSE_DISCOVERY_RATE = 0.05
# levels²: what rounding to 8 bits adds; keeps the PSNR of a perfect region finite
ROUNDING = 1 / 12
NOISY = 3.0  # dB: the deviation over seeds that is drawn black
BETTER, WORSE, NOTHING = (33, 102, 172), (178, 24, 43), (235, 235, 235)

Flags = NDArray[np.bool_]
Array = NDArray[np.float64]


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
class ViewRegions:
    """The regions [R, C] of a test view.

    ``change`` is the mean difference in dB (arm minus baseline, positive is better), ``p`` its
    two-sided p, and ``spread`` the standard deviation in dB over seeds of the baseline alone.
    """

    change: Array
    p: Array
    spread: Array


def compare_regions(
    arm: Sequence[Mapping[str, Array]], baseline: Sequence[Mapping[str, Array]]
) -> dict[str, ViewRegions]:
    """The comparison of a scene's views, from the region errors by view of each seed's pair.

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
    p = _p_values([each.reshape(seeds, -1) for each in differences])  # of [K, N] each
    return {
        view: ViewRegions(
            change=each.mean(axis=0),
            p=own.reshape(each.shape[1:]),
            spread=base.std(axis=0, ddof=1),
        )
        for view, each, own, base in zip(views, differences, p, theirs, strict=True)
    }


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


# ---- the pictures


def region_maps(
    trials: Sequence[TrialResult], answers: Iterable[Answer]
) -> dict[tuple[Arm, Arm], list[dict[str, Any]]]:
    """The maps of each scene by (baseline, arm); all regions of the report are one family.

    A scene has none with fewer than three pairs of seeds, or without pictures or their errors.
    """
    found: list[tuple[tuple[Arm, Arm], Sequence[TrialPair], dict[str, ViewRegions]]] = []
    for arms in dict.fromkeys((one.baseline, one.arm) for one in answers):
        for own in group_by(pair_trials(trials, *arms), lambda pair: pair[0].scene).values():
            if len(own) >= FEWEST_SEEDS:
                try:
                    errors = [[regions_of(pair[side]) for pair in own] for side in (1, 0)]
                    found.append((arms, own, compare_regions(*errors)))
                except InputError:
                    continue
    family = [view.p for _, _, scene in found for view in scene.values()]
    lit = iter(discoveries(family)) if family else iter(())
    maps: dict[tuple[Arm, Arm], list[dict[str, Any]]] = {}
    for arms, pairs, scene in found:
        of_views = {view: next(lit) for view in scene}
        maps.setdefault(arms, []).append(_map(pairs, scene, of_views))
    return maps


def _map(
    own: Sequence[TrialPair], scene: Mapping[str, ViewRegions], lit: dict[str, Flags]
) -> dict[str, Any]:
    """The test view of a scene with most lit regions, and the counts of all its views.

    Pictures are data URIs, in the photograph's size. Lit regions are drawn over the photograph if
    it is there.
    """
    better = {view: flags & (scene[view].change > 0) for view, flags in lit.items()}
    view = max(lit, key=lambda name: int(lit[name].sum()))
    colours = np.full((*lit[view].shape, 3), NOTHING, dtype=np.uint8)
    colours[lit[view]] = WORSE
    colours[better[view]] = BETTER
    grey = 255 * (1 - np.clip(scene[view].spread / NOISY, 0, 1))
    truth = read_truth(own[0][0], view)
    size = tuple(SIDE * count for count in grey.shape) if truth is None else truth.shape[:2]
    shown = _spread(colours, size)
    if truth is not None:
        shown = np.where(_spread(lit[view], size)[..., None], truth // 2 + shown // 2, truth)
    return {
        "scene": own[0][0].scene,
        "view": view,
        "seeds": len(own),
        "better": sum(int(flags.sum()) for flags in better.values()),
        "worse": sum(int((lit[name] & ~flags).sum()) for name, flags in better.items()),
        "regions": sum(flags.size for flags in lit.values()),
        "lit": jpeg_uri(shown),
        "noise": jpeg_uri(_spread(grey.astype(np.uint8), size)),
    }


def _spread(values: NDArray[Any], size: tuple[int, ...]) -> NDArray[Any]:
    """The values of regions [R, C, …] at each pixel [H, W, …] of a view of this size."""
    rows, columns = (
        np.minimum(np.arange(pixels) // SIDE, count - 1)
        for pixels, count in zip(size, values.shape, strict=False)
    )
    return values[np.ix_(rows, columns)]
