"""Machines that trials ran on and clouds that they started from, which may differ though settings are equal."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from gsbench.analysis.cells import by_key
from gsbench.analysis.results import TrialResult
from gsbench.runs.code import SHOWN
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


def held_out_notes(trials: Sequence[TrialResult]) -> list[str]:
    """A line for each way in which views were held out, with the scenes where there are several."""
    notes = []
    told = [trial for trial in trials if trial.record.held_out]
    ways = by_key(told, lambda trial: (trial.question, trial.record.held_out))
    for (question, words), group in sorted(ways.items(), key=lambda item: (-len(item[1]), item[0])):
        scenes = sorted({trial.scene for trial in group})
        counts = sorted({(trial.record.test_views or 0, trial.record.train_views or 0) for trial in group})
        views = " and ".join(f"{test} of {test + train} views" for test, train in counts)
        where = f", {', '.join(scenes)}" if len(ways) > 1 and len({trial.scene for trial in told}) > 1 else ""
        notes.append(f"Held out{f' ({question})' if question else ''}{where}: {words}; {views}.")
    return notes


def points_notes(trials: Sequence[TrialResult]) -> list[str]:
    """A line for each initialiser and choice of the views that made its points; none where photographs made none."""
    notes = []
    for (init, choice), group in sorted(by_key(trials, lambda trial: (trial.init, points_from(trial))).items()):
        if choice == "all":
            notes.append(f"Initial points of {init}: from all views, test views too (init.points_from=all).")
        elif choice:
            shares = [share for trial in group if (share := _taken(trial)) is not None]
            taken = f", without {min(shares):.0%}" if shares else ""
            taken += f" to {max(shares):.0%}" if shares and f"{min(shares):.0%}" != f"{max(shares):.0%}" else ""
            of = f"{taken} of those of all views" if shares else ""
            notes.append(f"Initial points of {init}: from training views alone (init.points_from={choice}){of}.")
    return notes


def points_from(trial: TrialResult) -> str:
    """The views that made the trial's initial points: all, train or retriangulated; "" where no observations did."""
    if "init.points_from" in trial.config:
        return str(trial.config["init.points_from"])
    return "all" if trial.record.init_report.get("mean_track_length") is not None else ""


def _taken(trial: TrialResult) -> float | None:
    """The share of points that went with the test views, where it is known."""
    found = trial.record.init_report.get("training_points")
    return found.get("removed") if isinstance(found, dict) else None


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
