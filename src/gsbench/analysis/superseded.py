"""Trials that were made by code which is no longer the present one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from gsbench.analysis.differences import CODE, short_version
from gsbench.analysis.results import TrialResult


def find_superseded(
    trials: Sequence[TrialResult], present: Callable[[str, TrialResult], str | None] = lambda target, trial: None
) -> dict[Path, str]:
    """Folders of trials whose code is no longer the present one, each with the reason.

    ``present(class, trial)`` is the hash of a user's class as its file is now, None where that cannot be seen; then
    the version that finished a trial last is the present one, as it is among the stages of gsbench.
    """
    reasons: dict[Path, str] = {}
    latest = {part: version for trial in sorted(trials, key=_finished) for part, version in _code(trial).items()}
    for trial in trials:
        for part, version in _code(trial).items():
            name = part.removeprefix(CODE)
            now = present(name, trial) if part.startswith(CODE) else None
            if version != (now or latest[part]):
                words = "its file is now" if now else "later trials have"
                newer = short_version(now or latest[part])
                reasons[trial.path] = f"{name} was {short_version(version)}, {words} {newer}"
    return reasons


def _code(trial: TrialResult) -> dict[str, str]:
    return trial.code | trial.files


def _finished(trial: TrialResult) -> float:
    return trial.finished
