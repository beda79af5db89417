"""Versions of an arm's code that were measured on the same scenes and seeds.

Whoever edits a densifier until its verdict pleases asks one question many times, and keeps the last
answer. So each further version has a smaller error rate.
"""

from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path

from gsbench.analysis.results import Arm, TrialResult, UnusableError, group_by, read_trial
from gsbench.analysis.trial_settings import Configurations
from gsbench.runs.experiments import list_experiments
from gsbench.runs.layout import SEED
from gsbench.runs.seen import Place, SeenResult, read_seen


def measured_versions(
    baseline: Sequence[TrialResult],
    arm: Sequence[TrialResult],
    older: Sequence[TrialResult],
    seen: Iterable[SeenResult] = (),
) -> int:
    """The number of versions of the arm's code that were measured on its pairs; at least 1.

    ``older`` are trials of earlier code, ``seen`` what was ever measured in the experiment. What
    they showed on other scenes or seeds says nothing about the present pairs. An edit that changed
    no result showed nothing new. An update of gsbench was no choice.
    """
    places = {trial.as_seen.place for trial in baseline} & {trial.as_seen.place for trial in arm}
    results = [trial.as_seen for trial in (*arm, *of_same_arm(arm, older))]
    results = [
        result for result in (*results, *earlier_results(arm, seen)) if result.place in places
    ]
    versions: list[Mapping[Place, SeenResult]] = []
    for same in group_by(results, lambda result: result.version).values():
        made = {result.place: result for result in same}
        if made and not any(_are_equal(made, known) for known in versions):
            versions.append(made)
    return max(1, len(versions))


def _are_equal(one: Mapping[Place, SeenResult], other: Mapping[Place, SeenResult]) -> bool:
    """Return whether results have the same bits on all common scenes and seeds."""
    common = one.keys() & other.keys()
    return bool(common) and all(one[place].has_bits_of(other[place]) for place in common)


def earlier_results(arm: Sequence[TrialResult], seen: Iterable[SeenResult]) -> list[SeenResult]:
    """The results of ``seen`` that are of the arm, on its scenes and seeds.

    These are all under its name, and those under other names that were measured before it: a later
    name never changes an earlier verdict.
    """
    present = [trial.as_seen for trial in arm]
    places, names = {result.place for result in present}, {result.name for result in present}
    made = {result.arm for result in present} - {""}
    first = min((trial.measured for trial in arm), default=0.0)
    return [
        result
        for result in seen
        if result.place in places
        and (result.arm in made if result.arm and made else result.name in names)
        and (result.name in names or result.moment < first)
    ]


def measured_elsewhere(
    home: Path, by_arm: Mapping[Arm, Sequence[TrialResult]]
) -> dict[Arm, list[str]]:
    """The other experiments than that in ``home`` that measured an arm by other code, by arm.

    Only trials of its data and seeds count: among these, the better code could be chosen. Each
    trial of another experiment is read at most once.
    """
    settings = Configurations()

    @cache
    def result_in(path: Path) -> SeenResult | None:
        try:
            return read_trial(path, home.parent, settings).as_seen
        except UnusableError:
            return None

    def results_of(other: str, arm: Sequence[TrialResult]) -> Iterable[SeenResult]:
        yield from recorded(other)
        known = {(result.scene, result.name, result.seed) for result in recorded(other)}
        for trial in arm:
            scene, name = trial.scene, f"{trial.init}-{trial.densify}"
            if (scene, name, trial.seed) in known:
                continue
            folder = home.parent / other / scene / name
            for path in folder.glob(f"*{SEED}{trial.seed}"):
                yield from filter(None, [result_in(path)])

    recorded = cache(lambda other: read_seen(home.parent / other))
    others = [other for other in list_experiments(home.parent) if other != home.name]
    found: dict[Arm, list[str]] = {}
    for arm, trials in by_arm.items():
        here = {trial.as_seen.place: trial.as_seen for trial in trials}
        versions = {result.version for result in here.values()}
        names = {result.name for result in here.values()}
        made = {result.arm for result in here.values()} - {""}
        for other in others if any(versions) else ():
            if any(
                result.place in here
                and (result.name in names or result.arm in made)
                and result.version not in versions
                and not result.has_bits_of(here[result.place])
                for result in results_of(other, trials)
            ):
                found.setdefault(arm, []).append(other)
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
