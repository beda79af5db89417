"""The notes below a table: who trained, on what, doubts, and how else the compared arms differ."""

from collections import Counter
from collections.abc import Sequence

from gsbench.analysis.comparison import Comparison
from gsbench.analysis.fairness import caveats, counts_notes
from gsbench.analysis.notes import Note
from gsbench.analysis.results import TrialResult, group_by
from gsbench.analysis.trial_result import seeds_text
from gsbench.events import FEWEST_ROUNDS
from gsbench.runs.configuration import SHOWN
from gsbench.runs.layout import EVENTS
from gsbench.runs.trial_record import FROM_MODEL, FROM_RENDERS
from gsbench.words import counted

LEARNT_NOTHING = "(!)"  # marks means over a trial that is not better than one colour
# notes on arms that gsbench did not train: whether another program trained them here, and the
# source of their metrics
ORIGINS = {
    (True, FROM_MODEL): "program's model",
    (True, FROM_RENDERS): "program's renders",
    (False, FROM_MODEL): "foreign model",
    (False, FROM_RENDERS): "foreign renders",
}


# Kinds of notes in the order of their weight; the others come after them.
HEAVIEST = (
    "one trial",
    "mean",
    "folded",
    "worthless",
    "unusable",
    "unused",
    "unequal counts",
    "no partner",
    "same bits",
    "not available",
    "few values",
    "no mean",
)


def by_weight(notes: Sequence[Note]) -> list[Note]:
    """The notes with the heaviest first, so that those are read."""
    weights = {kind: weight for weight, kind in enumerate(HEAVIEST)}
    return sorted(notes, key=lambda note: weights.get(note.kind, len(weights)))


def trials_notes(comparison: Comparison, trials: Sequence[TrialResult]) -> list[Note]:
    """All notes on ``trials`` of an experiment and on its comparisons."""
    return [
        *doubt_notes(trials),
        *origin_notes(trials),
        *comparison_notes(comparison),
        *held_out_notes(trials),
        *points_notes(trials),
        *machine_notes(trials),
        *cloud_notes(trials),
    ]


def comparison_notes(comparison: Comparison) -> list[Note]:
    """Notes on the compared arms: remarks and caveats."""
    by_arm = group_by(comparison.trials, "arm")
    between = [
        note
        for first, second in comparison.pairs
        for note in caveats([*by_arm[first], *by_arm[second]], first, second)
    ]
    counts = counts_notes(comparison.trials, comparison.pairs)
    return [*comparison.remarks, *counts, *between]


def doubt_notes(trials: Sequence[TrialResult]) -> list[Note]:
    """Notes on results that are worth little or may surprise.

    They are about renders not better than one colour, executors that failed their proof, and what
    rules found odd (`gsbench.scene.rules`).
    """
    notes = []
    if worthless := [trial for trial in trials if trial.record.learnt_nothing]:
        first, *more = worthless
        facts = {"trial": first.label, "what": first.record.learnt_nothing}
        others = f"; the same holds for {counted(len(more), 'more trial')}"
        notes.append(
            Note.of("worthless", mark=LEARNT_NOTHING, others=others if more else "", **facts)
        )
    for trial in trials:
        notes += [Note.of("passed over", text=line) for line in trial.record.raster_passed_over]
    by_arm = group_by(trials, lambda trial: trial.key.partition("/")[2])  # of one schedule each
    notes += [note for own in by_arm.values() if (note := _rounds_note(own[0]))]
    for trial in trials:
        place = {"scene": trial.scene, "init": trial.init}
        for odd in trial.record.oddities:
            kind = "accepted" if odd.refused else "odd"
            notes.append(Note.of(kind, **place, rule=odd.rule, doubt=odd.line))
    return list(dict.fromkeys(notes))  # trials of one cloud have the same notes


def _rounds_note(trial: TrialResult) -> Note | None:
    """A note if a trial's densifier had too few rounds to be judged by them."""
    if trial.program or trial.made_elsewhere or not (trial.path / EVENTS).is_file():
        return None
    rounds = len(trial.folder.curves(EVENTS))
    if rounds >= FEWEST_ROUNDS or not trial.config.get("densify.interval"):
        return None
    arm, iterations = f"{trial.init}-{trial.densify}", trial.record.iterations
    return Note.of("few rounds", arm=arm, rounds=rounds, iterations=iterations)


def origin_notes(trials: Sequence[TrialResult]) -> list[Note]:
    """Notes on arms that gsbench did not train: who did, and what was measured."""
    not_ours = [trial for trial in trials if trial.program or trial.made_elsewhere]
    by_origin = group_by(not_ours, lambda one: (bool(one.program), one.record.evaluated_from))
    notes = []
    for origin, kind in ORIGINS.items():
        made = {(one.arm.name, one.trainer_version) for one in by_origin.get(origin, [])}
        arms = [f"{arm} (version {version})" if origin[0] else arm for arm, version in sorted(made)]
        notes += [Note.of(kind, arms=arms)] if arms else []
    return notes


def machine_notes(trials: Sequence[TrialResult]) -> list[Note]:
    """A note that names the kinds of machine if trials ran on several."""
    kinds = Counter(trial.machine for trial in trials)
    unknown = kinds.pop(None, 0)
    if len(kinds) < 2:
        return []
    counts = [f"{kind}: {counted(count, 'trial')}" for kind, count in kinds.most_common()]
    counts += [f"not recorded: {unknown}"] if unknown else []
    return [Note.of("machines", kinds=len(kinds), trials=counts)]


def cloud_notes(trials: Sequence[TrialResult]) -> list[Note]:
    """A note for each scene and initialiser with equal settings but several clouds."""
    notes = []
    groups = group_by(
        trials, lambda trial: (trial.scene, trial.init, trial.record.hashes.get("init"))
    )
    for (scene, init, _), group in groups.items():
        clouds = group_by([trial for trial in group if trial.cloud], "cloud")
        if len(clouds) > 1:
            made = []
            for cloud, own in clouds.items():
                arms = group_by(own, "densify").items()
                texts = (f"{name} {seeds_text(one.seed for one in of)}" for name, of in arms)
                made.append(f"{cloud[:SHOWN]}: {'; '.join(texts)}")
            notes.append(Note.of("clouds", scene=scene, init=init, clouds=len(clouds), trials=made))
    return notes


def held_out_notes(trials: Sequence[TrialResult]) -> list[Note]:
    """A note for each way of holding views out, with its scenes if there are several ways."""
    notes = []
    recorded = [trial for trial in trials if trial.record.held_out]
    several_scenes = len({trial.scene for trial in recorded}) > 1
    splits = group_by(recorded, "question", "record.held_out")
    for (question, rule), own in sorted(splits.items(), key=lambda item: (-len(item[1]), item[0])):
        counts = sorted(
            {(trial.record.test_views or 0, trial.record.train_views or 0) for trial in own}
        )
        views = [f"{test} of {test + train} views" for test, train in counts]
        scenes = sorted({trial.scene for trial in own})
        named = ", ".join(scenes) if len(splits) > 1 and several_scenes else ""
        facts = {"question": question, "scenes": named, "rule": rule, "views": " and ".join(views)}
        notes.append(Note.of("held out", **facts))
    return notes


def points_notes(trials: Sequence[TrialResult]) -> list[Note]:
    """A note for each initialiser on the views that made its points, if photographs did."""
    found = set()
    for trial in trials:
        made_by_views = trial.record.init_report.get("mean_track_length") is not None
        choice = trial.config.get("init.points_from", "all" if made_by_views else "")
        found.add((trial.init, str(choice)))
    return [
        Note.of("points of all" if choice == "all" else "points of some", init=init, choice=choice)
        for init, choice in sorted(found)
        if choice
    ]
