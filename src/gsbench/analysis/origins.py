"""Machines that trials ran on and clouds that they started from, which may differ though settings are equal."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from gsbench.analysis.cells import by_key
from gsbench.analysis.results import TrialResult
from gsbench.runs.source import SHOWN
from gsbench.system.machine import kind_of_machine
from gsbench.words import counted


def machine_of(trial: TrialResult) -> str | None:
    """The kind of machine that trained the trial, in a phrase; None where it was not recorded."""
    try:
        return None if trial.record.machine is None else kind_of_machine(trial.record.machine)
    except KeyError:
        return None


def cloud_of(trial: TrialResult) -> str | None:
    """The hash of the initial model's files (cameras, poses, points); None where it was not recorded."""
    return trial.record.hashes.get("cloud")


def machine_notes(trials: Sequence[TrialResult]) -> list[str]:
    """A line that names the kinds of machine, where trials ran on several."""
    kinds = Counter(machine_of(trial) for trial in trials)
    unknown = kinds.pop(None, 0)
    if len(kinds) < 2:
        return []
    listed = "; ".join(f"{kind}: {counted(count, 'trial')}" for kind, count in kinds.most_common())
    rest = f"; not recorded: {unknown}" if unknown else ""
    return [
        f"The trials ran on {len(kinds)} kinds of machine, on which equal settings give unlike last digits and, after "
        f"thousands of iterations, unlike trials: {listed}{rest}."
    ]


def cloud_notes(trials: Sequence[TrialResult]) -> list[str]:
    """A line for each scene and initialiser whose trials, by the same settings, started from several clouds."""
    notes = []
    for (scene, init, _), group in by_key(trials, lambda trial: (trial.scene, trial.init, _init_key(trial))).items():
        clouds = by_key([trial for trial in group if cloud_of(trial)], cloud_of)
        if len(clouds) > 1:
            listed = "; ".join(f"{str(cloud)[:SHOWN]}: {_arms(own)}" for cloud, own in clouds.items())
            notes.append(f"{scene}: trials of init {init} started from {len(clouds)} different clouds ({listed}).")
    return notes


def cloud_lines(trials: Sequence[TrialResult]) -> list[str]:
    """List, for each scene and initialiser, the hashes of the clouds that its trials started from, and their points."""
    lines = []
    for (scene, init), group in sorted(by_key(trials, lambda trial: (trial.scene, trial.init)).items()):
        clouds = by_key(group, lambda trial: (cloud_of(trial), _init_key(trial), trial.record.num_init_points))
        parts = []
        for cloud, key, points in clouds:
            name = f"cloud {cloud[:SHOWN]}" if cloud else "cloud not recorded"
            parts.append(f"{name} (stage result {str(key)[:SHOWN]}, {points or 0:,} points)")
        lines.append(f"{scene}, {init}: {'; '.join(parts)}")
    return lines


def unlike_clouds(pairs: Sequence[tuple[TrialResult, TrialResult]]) -> list[str]:
    """A line for each scene in which trials that are compared started from different clouds."""
    notes: dict[str, str] = {}
    for one, other in pairs:
        first, second = cloud_of(one), cloud_of(other)
        if first is None or second is None:  # the stage's key says at least whether it was the same computation
            first, second = _init_key(one), _init_key(other)
        if first != second:
            places = f"{first[:SHOWN]} and {second[:SHOWN]}"
            notes.setdefault(one.scene, f"{one.scene}: the arms started from different clouds ({places})")
    return list(notes.values())


def _init_key(trial: TrialResult) -> str:
    return str(trial.record.hashes.get("init"))


def _arms(trials: Sequence[TrialResult]) -> str:
    """``adc seeds 0, 1; volumetric seed 0``"""
    return "; ".join(
        f"{densify} {'seed' if len(own) == 1 else 'seeds'} {', '.join(str(trial.seed) for trial in own)}"
        for densify, own in by_key(trials, lambda trial: trial.densify).items()
    )
