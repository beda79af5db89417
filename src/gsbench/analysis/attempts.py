"""Versions of an arm's code that were measured on the same scenes and seeds.

Whoever edits a densifier until its verdict pleases asks one question many times, and keeps the last
answer. So each further version has a smaller error rate.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
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
    places = set.intersection(*({one.as_seen.place for one in own} for own in (baseline, arm)))
    results = [trial.as_seen for trial in (*arm, *of_same_arm(arm, older))]
    results = [one for one in (*results, *earlier_results(arm, seen)) if one.place in places]
    versions: list[Mapping[Place, SeenResult]] = []
    for same in group_by(results, lambda one: one.version).values():
        found = {one.place: one for one in same}
        if not any(map(_equal_to(found), versions)):
            versions.append(found)
    return max(1, len(versions))


def _equal_to(
    one: Mapping[Place, SeenResult],
) -> Callable[[Mapping[Place, SeenResult]], bool]:
    """A function that tells whether other results have the same bits on all common places."""

    def is_equal(other: Mapping[Place, SeenResult]) -> bool:
        common = one.keys() & other.keys()
        return bool(common) and all(one[place].has_bits_of(other[place]) for place in common)

    return is_equal


def earlier_results(arm: Sequence[TrialResult], seen: Iterable[SeenResult]) -> list[SeenResult]:
    """The results of ``seen`` that are of the arm, on its scenes and seeds.

    These are all under its name, and those under other names that were measured before it: a later
    name never changes an earlier verdict.
    """
    own = [trial.as_seen for trial in arm]
    places, names = {one.place for one in own}, {one.name for one in own}
    made = {one.arm for one in own} - {""}
    first = min((trial.measured for trial in arm), default=0.0)
    return [
        one
        for one in seen
        if one.place in places
        and (one.arm in made if one.arm and made else one.name in names)
        and (one.name in names or one.moment < first)
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
        known = {(one.scene, one.name, one.seed) for one in recorded(other)}
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
        own = {trial.as_seen.place: trial.as_seen for trial in trials}
        versions, names = {one.version for one in own.values()}, {one.name for one in own.values()}
        made = {one.arm for one in own.values()} - {""}
        for other in others if any(versions) else ():
            if any(
                one.place in own
                and (one.name in names or one.arm in made)
                and one.version not in versions
                and not one.has_bits_of(own[one.place])
                for one in results_of(other, trials)
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
    return [one for one in older if arm and arm[0].arm.has(f"{one.init}-{one.densify}", one.config)]


def places_of(trials: Iterable[TrialResult]) -> set[tuple[str, int]]:
    """The scenes and seeds of trials."""
    return {(trial.scene, trial.seed) for trial in trials}
