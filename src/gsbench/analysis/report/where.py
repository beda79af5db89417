"""Maps of regions in the report: an arm's gain beyond noise (`analysis.regions`)."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbench.analysis.comparison import Answer
from gsbench.analysis.images import jpeg_uri, read_truth, regions_of
from gsbench.analysis.pairs import pair_trials
from gsbench.analysis.regions import (
    FEWEST_SEEDS,
    SIDE,
    SceneRegions,
    compare_regions,
    discoveries,
)
from gsbench.analysis.results import Arm, TrialPair, TrialResult, group_by
from gsbench.errors import InputError

NOISY = 3.0  # dB: the deviation over seeds that is drawn black
BETTER, WORSE, NOTHING = (33, 102, 172), (178, 24, 43), (235, 235, 235)

Flags = NDArray[np.bool_]
Array = NDArray[np.float64]


def region_maps(
    trials: Sequence[TrialResult], answers: Iterable[Answer]
) -> dict[tuple[Arm, Arm], list[dict[str, Any]]]:
    """The maps of each scene by (baseline, arm); all regions of the report are one family.

    A scene has none with fewer than three pairs of seeds, or without pictures or their errors.
    """
    found: list[tuple[tuple[Arm, Arm], Sequence[TrialPair], SceneRegions]] = []
    for arms in dict.fromkeys((one.baseline, one.arm) for one in answers):
        for own in group_by(pair_trials(trials, *arms), lambda pair: pair[0].scene).values():
            if len(own) >= FEWEST_SEEDS:
                try:
                    errors = [[regions_of(pair[side]) for pair in own] for side in (1, 0)]
                    found.append((arms, own, compare_regions(*errors)))
                except InputError:
                    continue
    family = [p for _, _, scene in found for p in scene.p.values()]
    lit = iter(discoveries(family)) if family else iter(())
    maps: dict[tuple[Arm, Arm], list[dict[str, Any]]] = {}
    for arms, pairs, scene in found:
        of_views = {view: next(lit) for view in scene.p}
        maps.setdefault(arms, []).append(_map(pairs, scene, of_views))
    return maps


def _map(own: Sequence[TrialPair], scene: SceneRegions, lit: dict[str, Flags]) -> dict[str, Any]:
    """The test view of a scene with most lit regions, and the counts of all its views.

    Pictures are data URIs, in the photograph's size. Lit regions are drawn over the photograph if
    it is there.
    """
    better = {view: flags & (scene.change[view] > 0) for view, flags in lit.items()}
    view = max(lit, key=lambda name: int(lit[name].sum()))
    colours = np.full((*lit[view].shape, 3), NOTHING, dtype=np.uint8)
    colours[lit[view]] = WORSE
    colours[better[view]] = BETTER
    grey = 255 * (1 - np.clip(scene.spread[view] / NOISY, 0, 1))
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
