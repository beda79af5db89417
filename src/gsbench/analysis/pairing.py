"""Pairing the trials of two arms by scene, seed and view, and naming what has no partner."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from gsbench.analysis.cells import by_key, check_averageable
from gsbench.analysis.differences import differing_conditions
from gsbench.analysis.per_view import read_views
from gsbench.analysis.results import Arm, TrialResult
from gsbench.errors import InputError

Views = Mapping[str, Mapping[str, float]]


@dataclass(frozen=True)
class Paired:
    """Second arm minus first in one metric: for each scene a matrix [trials, views] of differences.

    ``baseline_mean`` is the first arm's mean over the same scenes, trials and views; ``left_out`` says in one line each
    what could not be paired.
    """

    metric: str
    scenes: tuple[str, ...]
    differences: tuple[NDArray[np.float64], ...]
    baseline_mean: float
    left_out: tuple[str, ...]


BASELINE = "adc"
CONTROLS = "eval.controls."


class ViewCache:
    """Per-view metrics by trial, each file read once; a damaged one is remembered as its fault."""

    def __init__(self) -> None:
        self._views: dict[str, Views | InputError] = {}

    def __call__(self, trial: TrialResult) -> Views:
        key = str(trial.path)
        if key not in self._views:
            try:
                self._views[key] = read_views(trial)
            except InputError as error:
                self._views[key] = error
        found = self._views[key]
        if isinstance(found, InputError):
            raise found
        return found


def choose_pairs(
    arms: Sequence[Arm], baseline: str = BASELINE, controls: Mapping[str, str] = MappingProxyType({})
) -> list[tuple[Arm, Arm]]:
    """(baseline arm, other arm) for every densifier whose initialiser also has the baseline, then those of controls.

    A variant such as ``volumetric max_gaussians=30000`` is held against the baseline's own variant where there is one.
    Without the baseline, the other arms are held against the first of ``arms``. ``controls`` names for a densifier
    another one that it is held against besides (`controls_of`), where both are there.
    """
    pairs = []
    for init, name in arms:
        densifier, _, variant = name.partition(" ")
        partners = [arm for arm in ((init, f"{baseline} {variant}".strip()), (init, baseline)) if arm in arms]
        if partners and baseline not in (densifier, name):
            pairs.append((partners[0], (init, name)))
    pairs = pairs or [(arms[0], arm) for arm in arms[1:]]
    for init, name in arms:
        densifier, _, variant = name.partition(" ")
        control = controls.get(densifier)
        partners = [arm for arm in ((init, f"{control} {variant}".strip()), (init, control or "")) if arm in arms]
        if partners and control != densifier and (partners[0], (init, name)) not in pairs:
            pairs.append((partners[0], (init, name)))
    return pairs


def controls_of(trials: Sequence[TrialResult]) -> dict[str, str]:
    """The control of each densifier, another one that the trials' settings name (``eval.controls``)."""
    firsts = [group[0] for group in by_key(trials, lambda trial: trial.arm).values()]
    return {
        key.removeprefix(CONTROLS): str(value)
        for trial in firsts
        for key, value in trial.config.items()
        if key.startswith(CONTROLS)
    }


def arm_name(arm: Arm) -> str:
    return f"{arm[0]}-{arm[1]}"


def pair_arms(trials: Sequence[TrialResult], first: Arm, second: Arm, metric: str, views: ViewCache) -> Paired:
    """Pair the trials of two arms; raises ``InputError`` where nothing can be paired."""
    scenes, matrices, baselines, left_out = [], [], [], []
    for scene, group in by_key(trials, lambda trial: trial.scene).items():
        try:
            one, other = (_by_seed(group, arm, scene) for arm in (first, second))
            seeds, faults = _common_seeds(one, other, metric, scene)
            left_out += faults
            rows = [_view_rows(one[seed], other[seed], metric, views) for seed in seeds]
            if len({names for names, _, _ in rows}) > 1:
                raise InputError(f"{scene}: its trials have different views")
        except InputError as error:
            left_out.append(str(error))
            continue
        if rows:
            scenes.append(scene)
            matrices.append(np.array([after - before for _, before, after in rows]))  # [K, V]
            baselines.append(float(np.mean([before for _, before, _ in rows])))
    if not scenes:
        reason = f": {left_out[0]}" if left_out else ""
        raise InputError(f"no trials of {arm_name(first)} and {arm_name(second)} can be paired in {metric}{reason}")
    return Paired(metric, tuple(scenes), tuple(matrices), float(np.mean(baselines)), tuple(left_out))


def pair_trials(trials: Sequence[TrialResult], first: Arm, second: Arm) -> list[tuple[TrialResult, TrialResult]]:
    """The pairs (first arm, second arm) of one scene and seed, sorted; those under unlike conditions are left out."""
    pairs: list[tuple[TrialResult, TrialResult]] = []
    for scene, group in sorted(by_key(trials, lambda trial: trial.scene).items()):
        one, other = (_by_seed(group, arm, scene) for arm in (first, second))
        both = [(one[seed], other[seed]) for seed in sorted(one.keys() & other.keys())]
        pairs += [pair for pair in both if not differing_conditions(pair)]
    return pairs


def _by_seed(group: Sequence[TrialResult], arm: Arm, scene: str) -> dict[int, TrialResult]:
    own = [trial for trial in group if trial.arm == arm]
    if own:
        check_averageable(own, f"scene={scene} {arm_name(arm)}")
    return {trial.seed: trial for trial in own}


def _common_seeds(
    one: Mapping[int, TrialResult], other: Mapping[int, TrialResult], metric: str, scene: str
) -> tuple[list[int], list[str]]:
    """Seeds of both arms that have the metric, and what is left out; refuses arms under different conditions."""
    if one and other:
        differing = differing_conditions([*one.values(), *other.values()])
        if differing:
            raise InputError(f"{scene}: the arms differ in {', '.join(differing)}, so they are not compared")
    faults = [f"{scene}: seed {seed} has no partner" for seed in sorted(one.keys() ^ other.keys())]
    seeds = sorted(one.keys() & other.keys())
    without = {
        seed: trial.unavailable.get(metric, "")
        for seed in seeds
        for trial in (one[seed], other[seed])
        if metric not in trial.metrics
    }
    faults += [f"{scene}: seed {seed} has no {metric}{f' ({why})' if why else ''}" for seed, why in without.items()]
    return [seed for seed in seeds if seed not in without], faults


def _view_rows(
    one: TrialResult, other: TrialResult, metric: str, views: ViewCache
) -> tuple[tuple[str, ...], NDArray[np.float64], NDArray[np.float64]]:
    """(names, first arm's values [V], second arm's values [V]) of a pair of trials."""
    before, after = views(one), views(other)
    if before.keys() != after.keys():
        raise InputError(f"{one.scene}: {one.label} and {other.label} have different views")
    names = tuple(sorted(before))
    return names, np.array([before[n][metric] for n in names]), np.array([after[n][metric] for n in names])
