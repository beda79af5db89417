"""Notes below a table and beside a verdict: who trained, what was declared, in what else arms differ."""

from __future__ import annotations

from collections.abc import Sequence

from gsbench.analysis.attribution import attribute, attribution_sentence
from gsbench.analysis.cells import by_key, with_variants
from gsbench.analysis.declaration import standing
from gsbench.analysis.pairing import choose_pairs, controls_of
from gsbench.analysis.results import Arm, Experiment, TrialResult
from gsbench.analysis.tuning import tuning_sentence
from gsbench.runs.layout import TUNING
from gsbench.runs.trial_record import FROM_MODEL, FROM_RENDERS

_BY_PROGRAM = (
    ("Trained here by another program, its model rendered by gsbench", FROM_MODEL),
    ("Trained here by another program, its own renders measured as they are", FROM_RENDERS),
)


def origin_notes(trials: Sequence[TrialResult]) -> list[str]:
    """Lines that say which arms gsbench did not train, and what of them it saw."""
    notes = []
    for what, origin in _BY_PROGRAM:
        own = [trial for trial in trials if trial.program and trial.record.evaluated_from == origin]
        if own:
            versions = {(f"{trial.init}-{trial.densify}", trial.trainer_version) for trial in own}
            arms = ", ".join(f"{arm} (version {version})" for arm, version in sorted(versions))
            notes.append(f"{what} (its time is that of the whole program, its budget its own): {arms}.")
    for what, origin in (
        ("A model that another program trained, rendered here", FROM_MODEL),
        ("Renders of another program, measured as they are", FROM_RENDERS),
    ):
        own = [trial for trial in trials if trial.made_elsewhere and trial.record.evaluated_from == origin]
        if own:
            arms = ", ".join(sorted({f"{trial.init}-{trial.densify}" for trial in own}))
            notes.append(f"{what} (its conditions are not known): {arms}.")
    return notes


def declared_notes(experiment: Experiment) -> list[str]:
    """The verdict on the declared metric, of the whole experiment; nothing where none was declared.

    Which trials a table shows has no say in it, so that nobody can choose a verdict by choosing trials.
    """
    declared = standing(experiment.folder, experiment.trials)
    if declared is None or any(trial.translated_from for trial in experiment.trials):
        return []
    from gsbench.analysis.verdicts import declared_lines, judge  # here, for a quick start of what needs no test

    trials, pairs = compared_pairs(experiment)
    return declared_lines(declared, judge(trials, pairs, declared))


def caveat_notes(experiment: Experiment) -> list[str]:
    """A line for each pair of arms that differ in more than one ingredient, or of which one was tuned more."""
    trials, pairs = compared_pairs(experiment)
    return [sentence for pair in pairs if (sentence := caveats(trials, *pair))]


def equal_notes(experiment: Experiment) -> list[str]:
    """A line for each pair of arms that are equal to the last bit: what they differ in never acted."""
    trials, pairs = compared_pairs(experiment)
    notes = []
    for first, second in pairs:
        one, other = (
            {(trial.scene, trial.seed): outcome(trial) for trial in trials if trial.arm == arm}
            for arm in (first, second)
        )
        shared = one.keys() & other.keys()
        if shared and all(one[key] == other[key] and one[key][0] for key in shared):
            names = f"{second} and {first}"
            notes.append(f"{names} are equal to the last bit in all their trials: what they differ in never acted.")
    return notes


def outcome(trial: TrialResult) -> tuple[dict[str, float], int | None]:
    """All metrics and the number of Gaussians: two trainings that share them are one and the same."""
    return dict(trial.metrics), trial.record.num_gaussians


def compared_pairs(experiment: Experiment) -> tuple[list[TrialResult], list[tuple[Arm, Arm]]]:
    """The experiment's trials as arms, and the pairs of arms that are compared: none among the points of a search."""
    trials = with_variants(experiment.trials)
    if (experiment.folder / TUNING).exists():
        return trials, []
    arms = sorted({trial.arm for trial in trials})
    return trials, choose_pairs(arms, controls=controls_of(trials)) if arms else []


EQUAL_COUNTS = 0.02  # relative: arms closer than this have one count, as governed ones do


def caveats(trials: Sequence[TrialResult], first: Arm, second: Arm) -> str:
    """Say where two arms of ``trials`` have unlike counts, differ in more than one ingredient, and where one was tuned
    more; else "".
    """
    mixed = attribution_sentence(attribute(trials, first, second), first, second)
    counts = counts_sentence(trials, first, second)
    return " ".join(filter(None, [counts, mixed, tuning_sentence(trials, (first, second))]))


def counts_sentence(trials: Sequence[TrialResult], first: Arm, second: Arm) -> str:
    """Say how many more Gaussians the second arm has, over the scenes that both have; "" where counts are equal."""
    means = []
    for arm in (first, second):
        own = by_key([trial for trial in trials if trial.arm == arm], lambda trial: trial.scene)
        counts = {scene: [trial.record.num_gaussians or 0 for trial in group] for scene, group in own.items()}
        means.append({scene: sum(found) / len(found) for scene, found in counts.items() if all(found)})
    shared = means[0].keys() & means[1].keys()
    if not shared:
        return ""
    change = sum(means[1][scene] for scene in shared) / sum(means[0][scene] for scene in shared) - 1
    if abs(change) <= EQUAL_COUNTS:
        return ""
    more = f"{abs(change):.0%}".replace("%", " %") + (" more" if change > 0 else " fewer")
    return (
        f"{second} has {more} Gaussians than {first}: this is no comparison at one count, which "
        "densify.cap=governor makes."
    )
