"""Notes below tables and beside verdicts: who trained, what was declared, how else the arms differ."""

from collections import Counter
from collections.abc import Sequence

from gsbench.analysis.cells import with_variants
from gsbench.analysis.declaration import active_declaration
from gsbench.analysis.fairness import caveats
from gsbench.analysis.pairing import choose_pairs, controls_of
from gsbench.analysis.results import Arm, Experiment, TrialResult, group_by, seeds_words
from gsbench.runs.code import SHOWN
from gsbench.runs.layout import TUNING
from gsbench.runs.trial_record import FROM_MODEL, FROM_RENDERS
from gsbench.words import counted

ORIGINS = (  # trained here by another program (or elsewhere), what was measured, and its description
    (True, FROM_MODEL, "Trained here by another program, its model rendered by gsbench"),
    (True, FROM_RENDERS, "Trained here by another program, its own renders measured as they are"),
    (False, FROM_MODEL, "A model that another program trained, rendered here"),
    (False, FROM_RENDERS, "Renders of another program, measured as they are"),
)


def trials_notes(experiment: Experiment, trials: Sequence[TrialResult]) -> list[str]:
    """All notes on ``trials`` of an experiment and on its comparisons."""
    return [
        *origin_notes(trials),
        *comparison_notes(experiment),
        *held_out_notes(trials),
        *points_notes(trials),
        *machine_notes(trials),
        *cloud_notes(trials),
    ]


def origin_notes(trials: Sequence[TrialResult]) -> list[str]:
    """Lines on the arms that gsbench did not train: who did, and whether a model or renders were measured."""
    notes = []
    not_ours = [trial for trial in trials if trial.program or trial.made_elsewhere]
    for trained_here, measured, what in ORIGINS:
        own = [t for t in not_ours if bool(t.program) == trained_here and t.record.evaluated_from == measured]
        versions = sorted({(f"{trial.init}-{trial.densify}", trial.trainer_version) for trial in own})
        arms = ", ".join(f"{arm} (version {version})" if trained_here else arm for arm, version in versions)
        limits = (
            "its time is that of the whole program, and it sets its own budget"
            if trained_here
            else "its conditions are not known"
        )
        notes += [f"{what} ({limits}): {arms}."] if own else []
    return notes


def comparison_notes(experiment: Experiment) -> list[str]:
    """Lines on the compared arms: the declared verdict, arms that are equal to the last bit, and caveats.

    They are about the whole experiment, so choosing the trials that a table shows cannot change a verdict.
    """
    trials, pairs = compared_pairs(experiment)
    declared = active_declaration(experiment.folder, experiment.trials)
    notes = []
    if declared is not None:
        from gsbench.analysis.verdicts import declared_lines, judge_pairs  # here, since SciPy is slow to import

        notes = declared_lines(declared, judge_pairs(trials, pairs, declared))
    by_arm = group_by(trials, lambda trial: trial.arm)
    for first, second in pairs:
        if _are_equal(by_arm[first], by_arm[second]):
            names = f"{second} and {first}"
            notes.append(
                f"{names} are equal to the last bit in all their trials: the settings that differ had no effect."
            )
    sentences = (caveats([*by_arm[first], *by_arm[second]], first, second) for first, second in pairs)
    return notes + list(filter(None, sentences))


def _are_equal(first: Sequence[TrialResult], second: Sequence[TrialResult]) -> bool:
    """Return whether all trials of one scene and seed have the same metrics and number of Gaussians."""
    one, other = (
        {(trial.scene, trial.seed): (dict(trial.metrics), trial.record.num_gaussians) for trial in own}
        for own in (first, second)
    )
    shared = one.keys() & other.keys()
    return bool(shared) and all(one[key] == other[key] and one[key][0] for key in shared)


def compared_pairs(experiment: Experiment) -> tuple[list[TrialResult], list[tuple[Arm, Arm]]]:
    """The experiment's trials with their variants, and the pairs of arms to compare: none in a search."""
    trials = with_variants(experiment.trials)
    if (experiment.folder / TUNING).exists():
        return trials, []
    arms = sorted({trial.arm for trial in trials})
    return trials, choose_pairs(arms, controls=controls_of(trials)) if arms else []


def machine_notes(trials: Sequence[TrialResult]) -> list[str]:
    """A line that names the kinds of machine if trials ran on several."""
    kinds = Counter(trial.machine for trial in trials)
    unknown = kinds.pop(None, 0)
    if len(kinds) < 2:
        return []
    listed = "; ".join(f"{kind}: {counted(count, 'trial')}" for kind, count in kinds.most_common())
    rest = f"; not recorded: {unknown}" if unknown else ""
    return [
        f"The trials ran on {len(kinds)} kinds of machine: {listed}{rest}. There equal settings give other last digits "
        "and, after thousands of iterations, other results."
    ]


def cloud_notes(trials: Sequence[TrialResult]) -> list[str]:
    """A line for each scene and initialiser whose trials have the same settings but started from several clouds."""
    notes = []
    groups = group_by(trials, lambda trial: (trial.scene, trial.init, trial.record.hashes.get("init")))
    for (scene, init, _), group in groups.items():
        clouds = group_by([trial for trial in group if trial.cloud], lambda trial: trial.cloud)
        if len(clouds) > 1:
            listed = "; ".join(f"{cloud[:SHOWN]}: {_arms(own)}" for cloud, own in clouds.items())
            notes.append(f"{scene}: trials of init {init} started from {len(clouds)} different clouds ({listed}).")
    return notes


def held_out_notes(trials: Sequence[TrialResult]) -> list[str]:
    """A line for each way in which views were held out; it names the scenes if there are several ways and scenes."""
    notes = []
    recorded = [trial for trial in trials if trial.record.held_out]
    splits = group_by(recorded, lambda trial: (trial.question, trial.record.held_out))
    for (question, words), group in sorted(splits.items(), key=lambda item: (-len(item[1]), item[0])):
        scenes = sorted({trial.scene for trial in group})
        counts = sorted({(trial.record.test_views or 0, trial.record.train_views or 0) for trial in group})
        views = " and ".join(f"{test} of {test + train} views" for test, train in counts)
        where = f", {', '.join(scenes)}" if len(splits) > 1 and len({trial.scene for trial in recorded}) > 1 else ""
        notes.append(f"Held out{f' ({question})' if question else ''}{where}: {words}; {views}.")
    return notes


def points_notes(trials: Sequence[TrialResult]) -> list[str]:
    """A line for each initialiser on the views that made its points; none for points that no photographs made."""
    notes = []
    for init, choice in sorted({(trial.init, _points_from(trial)) for trial in trials}):
        if choice == "all":
            notes.append(f"Initial points of {init}: from all views, test views included (init.points_from=all).")
        elif choice:
            notes.append(f"Initial points of {init}: from training views alone (init.points_from={choice}).")
    return notes


def _points_from(trial: TrialResult) -> str:
    """The views that made the trial's initial points: all or train; "" if no views did."""
    if "init.points_from" in trial.config:
        return str(trial.config["init.points_from"])
    return "all" if trial.record.init_report.get("mean_track_length") is not None else ""


def _arms(trials: Sequence[TrialResult]) -> str:
    """``adc seeds 0, 1; volumetric seed 0``"""
    groups = group_by(trials, lambda trial: trial.densify)
    return "; ".join(f"{densify} {seeds_words(own)}" for densify, own in groups.items())
