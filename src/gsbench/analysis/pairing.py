"""Pairs of arms that are held against each other, and the metrics of single views, each file read once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

from gsbench.analysis.cells import by_key
from gsbench.analysis.per_view import read_views
from gsbench.analysis.results import Arm, TrialResult
from gsbench.errors import InputError

Views = Mapping[str, Mapping[str, float]]

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

    An arm with swept settings is held against the baseline with the same ones where there is one. Without the baseline,
    the other arms are held against the first of ``arms``. ``controls`` names for a densifier another one that it is
    held against besides (`controls_of`), where both are there.
    """

    def partners(arm: Arm, densify: str) -> list[Arm]:
        alike = replace(arm, densify=densify)
        return [one for one in (alike, replace(alike, variant=())) if one in arms]

    pairs = [(found[0], arm) for arm in arms if arm.densify != baseline and (found := partners(arm, baseline))]
    pairs = pairs or [(arms[0], arm) for arm in arms[1:]]
    for arm in arms:
        control = controls.get(arm.densify, arm.densify)
        found = [] if control == arm.densify else partners(arm, control)
        if found and (found[0], arm) not in pairs:
            pairs.append((found[0], arm))
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
