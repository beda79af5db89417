"""Versions of an arm's code that were measured on the same scenes and seeds.

Whoever edits a densifier until its verdict pleases asks one question many times, and keeps the last
answer. So each further version has a smaller error rate.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path

from gsbench.analysis.results import TrialResult, UnusableError, read_trial
from gsbench.analysis.trial_settings import Configurations
from gsbench.runs.experiments import folders_in, list_experiments


def measured_versions(
    baseline: Sequence[TrialResult], arm: Sequence[TrialResult], older: Sequence[TrialResult]
) -> int:
    """The number of versions of the arm's code that were measured on its pairs; at least 1.

    ``older`` are trials of earlier code. What they showed on other scenes or seeds says nothing
    about the present pairs. Code that changed for the baseline too, as by an update of gsbench,
    was no choice between the two arms.
    """
    of_baseline = [*baseline, *of_same_arm(baseline, older)]
    of_arm = [*arm, *of_same_arm(arm, older)]
    pairs = places_of(baseline) & places_of(arm)
    parts = {part for trial in of_arm for part in trial.code}
    chosen = [part for part in parts if len({trial.code.get(part) for trial in of_baseline}) < 2]
    versions = {
        tuple(trial.code.get(part) for part in chosen)
        for trial in of_arm
        if (trial.scene, trial.seed) in pairs
    }
    return max(1, len(versions))


def measured_elsewhere(
    runs: Path, name: str, baseline: Sequence[TrialResult], arm: Sequence[TrialResult]
) -> list[str]:
    """The other experiments in ``runs`` than ``name`` that measured the arm by other user's code.

    Only trials of its scenes, data and seeds count: among these, the better code could be chosen.
    """
    shared = {part for trial in baseline for part in trial.code}
    versions = {
        part: {trial.code.get(part) for trial in arm}
        for part in {part for trial in arm for part in trial.code}
        if part.kind == "module" and part not in shared
    }
    places = {(trial.scene, trial.seed, trial.record.hashes.get("data")) for trial in arm}

    def is_other(path: str) -> bool:
        try:
            trial = read_trial(Path(path), runs, settings)
        except UnusableError:
            return False
        own = trial.code
        edited = any(part in own and own[part] not in known for part, known in versions.items())
        return edited and (trial.scene, trial.seed, trial.record.hashes.get("data")) in places

    settings, found = Configurations(), []
    for other in list_experiments(runs) if versions else ():
        arms = {runs / other / trial.scene / f"{trial.init}-{trial.densify}" for trial in arm}
        paths = (path for folder in sorted(arms) if folder.is_dir() for path in folders_in(folder))
        if other != name and any(map(is_other, paths)):
            found.append(other)
    return found


def share_of_version(number: int) -> float:
    """The part of an error rate that the version with this number (from 1) has: 1, 1/3, 1/6, ….

    All parts sum to 2, and a test with two sides is falsely "better" in half of its error rate. So
    an arm without an effect is ever called better with at most the whole rate, however often its
    code was edited and whatever its versions have in common.
    """
    return 2 / (number * (number + 1))


def of_same_arm(arm: Sequence[TrialResult], older: Iterable[TrialResult]) -> list[TrialResult]:
    """The trials of earlier code with the name and the swept settings of an arm."""
    return [
        trial
        for trial in older
        if arm and arm[0].arm.has(f"{trial.init}-{trial.densify}", trial.config)
    ]


def places_of(trials: Iterable[TrialResult]) -> set[tuple[str, int]]:
    """The scenes and seeds of trials."""
    return {(trial.scene, trial.seed) for trial in trials}
