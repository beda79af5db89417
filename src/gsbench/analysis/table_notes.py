"""Notes below a table: doubts about results, who trained, verdicts, and how trials differ."""

from collections import Counter
from collections.abc import Sequence

from gsbench.analysis.fairness import caveats
from gsbench.analysis.results import Experiment, TrialResult, group_by, seeds_text
from gsbench.events import FEWEST_ROUNDS, few_rounds
from gsbench.runs.layout import EVENTS
from gsbench.runs.nested import SHOWN
from gsbench.runs.trial_record import FROM_MODEL, FROM_RENDERS, TwinViews
from gsbench.words import counted, some_of

LEARNT_NOTHING = "(!)"  # marks means over a trial that is not better than one colour
# trained here by another program (or elsewhere), what was measured, and its description
ORIGINS = (
    (True, FROM_MODEL, "Trained here by another program, its model rendered by gsbench"),
    (True, FROM_RENDERS, "Trained here by another program, its own renders measured as they are"),
    (False, FROM_MODEL, "A model that another program trained, rendered here"),
    (False, FROM_RENDERS, "Renders of another program, measured as they are"),
)


def trials_notes(experiment: Experiment, trials: Sequence[TrialResult]) -> list[str]:
    """All notes on ``trials`` of an experiment and on its comparisons."""
    return [
        *doubt_notes(trials),
        *origin_notes(trials),
        *edited_notes(trials),
        *comparison_notes(experiment),
        *held_out_notes(trials),
        *points_notes(trials),
        *machine_notes(trials),
        *cloud_notes(trials),
    ]


def doubt_notes(trials: Sequence[TrialResult]) -> list[str]:
    """Lines on results that are worth little or may surprise.

    They are about renders not better than one colour, executors that failed their proof, pictures
    made by different filters, twins, and doubts about initial points.
    """
    notes = []
    for trial in trials:
        if line := trial.record.learnt_nothing:
            notes.append(f"{LEARNT_NOTHING} {trial.label} is {line}.")
        notes += [f"{line}." for line in trial.record.raster_passed_over]
    known = [trial.config for trial in trials if trial.config]
    folders = {config.get("scene.images") for config in known}
    downscales = {config.get("scene.downscale") for config in known}
    if len(folders) > 1 and len(downscales) > 1:
        notes.append(
            "Pictures of scene.images and of scene.downscale were made by different filters: "
            "results on them differ by about 0.3 to 0.45 dB."
        )
    for trial in trials:
        twins = trial.record.twins or TwinViews()
        if twins.near:
            count = f"{len(twins.near)} of {trial.record.test_views} test views have"
            notes.append(
                f"{trial.scene}: {count} a near twin in training, so they measure memory too."
            )
        if twins.left_out:
            left_out = counted(len(twins.left_out), "photograph")
            notes.append(
                f"{trial.scene}: {left_out} left out, since another one has its name or content."
            )
    notes += [
        line for of_arm in group_by(trials, arm_of).values() if (line := rounds_note(of_arm[0]))
    ]
    for trial in trials:
        cloud = trial.record.initial_cloud
        lines = [] if cloud is None else cloud.warnings
        notes += [f"Before training, {trial.scene} {trial.init}: {line}." for line in lines]
    return list(dict.fromkeys(notes))  # trials of one cloud have the same lines


def arm_of(trial: TrialResult) -> str:
    """The arm's folder with its settings' hash: trials that share it have one schedule."""
    return trial.key.partition("/")[2]


def rounds_note(trial: TrialResult) -> str:
    """A line if a trial's densifier had too few rounds to be judged by them; else ""."""
    if trial.program or trial.made_elsewhere or not (trial.path / EVENTS).is_file():
        return ""
    rounds = len(trial.folder.curves(EVENTS))
    if rounds >= FEWEST_ROUNDS or not trial.config.get("densify.interval"):
        return ""
    return few_rounds(f"{trial.init}-{trial.densify}", rounds, trial.record.iterations)


def origin_notes(trials: Sequence[TrialResult]) -> list[str]:
    """Lines on arms that gsbench did not train: who did, and what was measured."""
    notes = []
    not_ours = [trial for trial in trials if trial.program or trial.made_elsewhere]
    for trained_here, measured, what in ORIGINS:
        of_kind = [
            t
            for t in not_ours
            if bool(t.program) == trained_here and t.record.evaluated_from == measured
        ]
        versions = sorted(
            {(f"{trial.init}-{trial.densify}", trial.trainer_version) for trial in of_kind}
        )
        arms = ", ".join(
            f"{arm} (version {version})" if trained_here else arm for arm, version in versions
        )
        limits = (
            "its time is that of the whole program, and it sets its own budget"
            if trained_here
            else "its conditions are not known"
        )
        notes += [f"{what} ({limits}): {arms}."] if of_kind else []
    return notes


def edited_notes(trials: Sequence[TrialResult]) -> list[str]:
    """A line for each of the user's modules that was edited after it made some of the trials."""
    of_module: dict[str, list[TrialResult]] = {}
    for trial in trials:
        for edit in trial.edits:
            of_module.setdefault(edit.name, []).append(trial)
    return [
        f"{module} was edited since: {counted(len(older), 'trial')} of "
        f"{some_of(sorted({f'{t.init}-{t.densify}' for t in older}))} are of the old code. "
        "Give the command again to run the new one."
        for module, older in of_module.items()
    ]


def comparison_notes(experiment: Experiment) -> list[str]:
    """Lines on the compared arms: the verdicts, what no verdict uses, and caveats.

    They are about the whole experiment, so choosing the trials that a table shows cannot change a
    verdict.
    """
    # here, since SciPy is slow to import
    from gsbench.analysis.comparison import compare

    comparison = compare(experiment)
    by_arm = group_by(comparison.trials, lambda trial: trial.arm)
    sentences = (
        caveats([*by_arm[first], *by_arm[second]], first, second)
        for first, second in comparison.pairs
    )
    return [*comparison.lines(), *filter(None, sentences)]


def machine_notes(trials: Sequence[TrialResult]) -> list[str]:
    """A line that names the kinds of machine if trials ran on several."""
    kinds = Counter(trial.machine for trial in trials)
    unknown = kinds.pop(None, 0)
    if len(kinds) < 2:
        return []
    listed = "; ".join(f"{kind}: {counted(count, 'trial')}" for kind, count in kinds.most_common())
    rest = f"; not recorded: {unknown}" if unknown else ""
    return [
        f"The trials ran on {len(kinds)} kinds of machine: {listed}{rest}. There equal settings "
        "give other last digits and, after thousands of iterations, other results."
    ]


def cloud_notes(trials: Sequence[TrialResult]) -> list[str]:
    """A line for each scene and initialiser with equal settings but several clouds."""
    notes = []
    groups = group_by(
        trials, lambda trial: (trial.scene, trial.init, trial.record.hashes.get("init"))
    )
    for (scene, init, _), group in groups.items():
        clouds = group_by([trial for trial in group if trial.cloud], lambda trial: trial.cloud)
        if len(clouds) > 1:
            listed = "; ".join(
                f"{cloud[:SHOWN]}: {_arms(of_cloud)}" for cloud, of_cloud in clouds.items()
            )
            notes.append(
                f"{scene}: trials of init {init} started from {len(clouds)} different clouds "
                f"({listed})."
            )
    return notes


def held_out_notes(trials: Sequence[TrialResult]) -> list[str]:
    """A line for each way of holding views out, with its scenes if there are several ways."""
    notes = []
    recorded = [trial for trial in trials if trial.record.held_out]
    splits = group_by(recorded, lambda trial: (trial.question, trial.record.held_out))
    for (question, words), group in sorted(
        splits.items(), key=lambda item: (-len(item[1]), item[0])
    ):
        scenes = sorted({trial.scene for trial in group})
        counts = sorted(
            {(trial.record.test_views or 0, trial.record.train_views or 0) for trial in group}
        )
        views = " and ".join(f"{test} of {test + train} views" for test, train in counts)
        where = (
            f", {', '.join(scenes)}"
            if len(splits) > 1 and len({trial.scene for trial in recorded}) > 1
            else ""
        )
        notes.append(f"Held out{f' ({question})' if question else ''}{where}: {words}; {views}.")
    return notes


def points_notes(trials: Sequence[TrialResult]) -> list[str]:
    """A line for each initialiser on the views that made its points, if photographs did."""
    notes = []
    for init, choice in sorted({(trial.init, _points_from(trial)) for trial in trials}):
        if choice == "all":
            notes.append(
                f"Initial points of {init}: from all views, test views included "
                "(init.points_from=all)."
            )
        elif choice:
            notes.append(
                f"Initial points of {init}: from training views alone (init.points_from={choice})."
            )
    return notes


def _points_from(trial: TrialResult) -> str:
    """The views that made the trial's initial points: all or train; "" if no views did."""
    if "init.points_from" in trial.config:
        return str(trial.config["init.points_from"])
    return "all" if trial.record.init_report.get("mean_track_length") is not None else ""


def _arms(trials: Sequence[TrialResult]) -> str:
    """``adc seeds 0, 1; volumetric seed 0``"""
    groups = group_by(trials, lambda trial: trial.densify)
    return "; ".join(f"{densify} {seeds_text(of_arm)}" for densify, of_arm in groups.items())
