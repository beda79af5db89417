"""Differences between trials: the conditions, the settings, and the versions of the code that made them."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

from gsbench.analysis.configurations import canonical
from gsbench.analysis.results import TrialResult
from gsbench.runs.code import SHOWN
from gsbench.words import counted

Versions = dict[str, list[TrialResult]]  # version -> the trials that it made

# Settings in which trials of one cell may differ: they name the trial or say where it runs, not what is computed.
IGNORED_SETTINGS = (
    *("seed", "name", "device", "threads", "tracking.", "launch.", "hydra.", "experiment", "scene.path"),
    *("eval.primary", "eval.controls", "densify.switches"),
)
CODE = "code of "  # how the keys of ``TrialResult.code`` start that are a user's modules


def differing_conditions(trials: Sequence[TrialResult], code: bool = True) -> dict[str, list[str]]:
    """The conditions in which trials differ, with their values; the ``code`` that made them is one, where it counts.

    Unlike budgets of which none acted are no difference: all of the trials grew as they liked.
    """
    seen: dict[str, set[str]] = defaultdict(set)
    for trial in trials:
        for key, value in trial.conditions.items():
            seen[key].add(value)
    for part, versions in (differing_code(trials) if code else {}).items():
        seen[part] = {short_version(version) for version in versions}
    if not any(trial.budget_acted for trial in trials):
        seen.pop("budget", None)
    return {key: sorted(values) for key, values in seen.items() if len(values) > 1}


def differing_settings(trials: Sequence[TrialResult]) -> dict[str, list[str]]:
    """The settings in which trials with different configuration hashes differ, those that may differ left out.

    A key that a configuration lacks counts as unset: a metric that was added later is null in earlier trials.
    """
    if len({trial.config_hash for trial in trials}) == 1:
        return {}
    known = {trial.key: trial.config_texts for trial in trials}.values()
    keys = {key for texts in known for key in texts if not key.startswith(IGNORED_SETTINGS)}
    values = {key: {texts.get(key, canonical(None)) for texts in known} for key in keys}
    return {key: sorted(found) for key, found in sorted(values.items()) if len(found) > 1}


def differing_code(trials: Iterable[TrialResult]) -> dict[str, Versions]:
    """The user's modules, stages and rooms of gsbench of which the trials used several versions; of many rooms, one."""
    trials = list(trials)
    found = _several(trials, lambda trial: trial.code)
    rooms = list(_several(trials, lambda trial: trial.rooms).items())
    if rooms:
        part, versions = rooms[0]
        found[part if len(rooms) == 1 else f"{part} and {counted(len(rooms) - 1, 'more room')}"] = versions
    return found


def _several(trials: Iterable[TrialResult], parts: Callable[[TrialResult], Mapping[str, str]]) -> dict[str, Versions]:
    found: dict[str, Versions] = defaultdict(lambda: defaultdict(list))
    for trial in trials:
        for part, version in parts(trial).items():
            found[part][version].append(trial)
    return {part: dict(versions) for part, versions in found.items() if len(versions) > 1}


def describe_code(part: str, versions: Mapping[str, Sequence[TrialResult]]) -> str:
    """``mine.Patient: 3fa9c1d2 (garden seeds 0, 1; 2026-11-21 18:40) | …``, the oldest version first."""
    ordered = sorted(versions.items(), key=lambda item: max(trial.finished for trial in item[1]))
    texts = [f"{short_version(version)} ({_places(own)}; {_when(own)})" for version, own in ordered]
    return f"{part.removeprefix(CODE)}: {' | '.join(texts)}"


def short_version(version: str) -> str:
    """A version as people see it: the start of a hash."""
    return version[:SHOWN]


def _places(trials: Sequence[TrialResult]) -> str:
    """``garden seeds 0, 1; room seed 0``"""
    seeds: dict[str, list[int]] = defaultdict(list)
    for trial in trials:
        seeds[trial.scene].append(trial.seed)
    return "; ".join(
        f"{scene} {'seed' if len(found) == 1 else 'seeds'} {', '.join(map(str, sorted(found)))}"
        for scene, found in sorted(seeds.items())
    )


def _when(trials: Sequence[TrialResult]) -> str:
    """Time at which the trials were finished: a minute, or the first and the last."""
    times = sorted(trial.finished for trial in trials)
    minutes = [time.strftime("%Y-%m-%d %H:%M", time.localtime(finished)) for finished in times]
    return minutes[0] if minutes[0] == minutes[-1] else f"{minutes[0]} to {minutes[-1]}"


def find_superseded(
    trials: Sequence[TrialResult], present: Callable[[str, TrialResult], str | None] = lambda module, trial: None
) -> dict[Path, str]:
    """Folders of trials whose code is no longer the present one, each with the reason.

    ``present(module, trial)`` is the hash of a user's module as it is now, None where that cannot be seen; then
    the version that finished a trial last is the present one, as it is among the stages of gsbench.
    """
    reasons: dict[Path, str] = {}
    latest = {part: version for trial in sorted(trials, key=_finished) for part, version in _code(trial).items()}
    for trial in trials:
        for part, version in _code(trial).items():
            name = part.removeprefix(CODE)
            now = present(name, trial) if part.startswith(CODE) else None
            if version != (now or latest[part]):
                words = "it is now" if now else "later trials have"
                newer = short_version(now or latest[part])
                reasons[trial.path] = f"{name} was {short_version(version)}, {words} {newer}"
    return reasons


def _code(trial: TrialResult) -> dict[str, str]:
    return trial.code | trial.rooms


def _finished(trial: TrialResult) -> float:
    return trial.finished
