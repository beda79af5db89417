"""Trials that were made by code which is no longer the present one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from gsbench.analysis.cells import by_key
from gsbench.analysis.differences import CODE, IGNORED_SETTINGS, differing_unrecorded_code, short_version
from gsbench.analysis.results import TrialResult, canonical


def find_superseded(
    trials: Sequence[TrialResult], present: Callable[[str, TrialResult], str | None] = lambda target, trial: None
) -> dict[Path, str]:
    """Folders of trials whose code is no longer the present one, each with the reason.

    ``present(class, trial)`` is the hash of a user's class as its file is now, None where that cannot be seen; then
    the version that finished a trial last is the present one, as it is among the stages of gsbench.
    """
    reasons = _superseded_unrecorded(trials)
    latest = {part: version for trial in sorted(trials, key=_finished) for part, version in trial.code.items()}
    for trial in trials:
        for part, version in trial.code.items():
            name = part.removeprefix(CODE)
            now = present(name, trial) if part.startswith(CODE) else None
            if version != (now or latest[part]):
                words = "its file is now" if now else "later trials have"
                newer = short_version(now or latest[part])
                reasons[trial.path] = f"{name} was {short_version(version)}, {words} {newer}"
    return reasons


def _superseded_unrecorded(trials: Sequence[TrialResult]) -> dict[Path, str]:
    """Trials without recorded versions where a later one of the same arm and settings was made by another version."""
    reasons: dict[Path, str] = {}
    for arm in by_key(trials, lambda trial: (trial.scene, trial.init, trial.densify)).values():
        if len({trial.config_hash for trial in arm}) == 1 or all("code" in trial.data for trial in arm):
            continue
        for group in by_key(arm, _settings).values():
            newest = max(group, key=_finished)
            for trial in group:
                if differing_unrecorded_code([trial, newest]):
                    reasons[trial.path] = f"a later trial has the same settings and configuration {newest.config_hash}"
    return reasons


def _settings(trial: TrialResult) -> str:
    """The settings that trials of one cell share, as comparable text."""
    return canonical({key: value for key, value in trial.config.items() if not key.startswith(IGNORED_SETTINGS)})


def _finished(trial: TrialResult) -> float:
    return trial.finished
