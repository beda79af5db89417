"""Differences between trials and between arms: conditions, settings, code and *ingredients*.

An ingredient is one difference that may explain a result. Each setting is an ingredient; settings
that belong together share one name. A densifier class adds the ingredients in which it departs from
ADC. All are read from the trials' recorded configurations and code.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from operator import attrgetter
from typing import Any

from gsbench.analysis.notes import Note
from gsbench.analysis.results import Arm, TrialPair, TrialResult, group_by
from gsbench.analysis.trial_result import Trained, canonical
from gsbench.gaussians.paper_values import RATES
from gsbench.parsing import table_beside
from gsbench.runs.configuration import SHOWN, is_ignored, is_ingredient, is_of_scene
from gsbench.runs.freshness import Part
from gsbench.words import counted, some_of

Versions = dict[str, list[TrialResult]]  # version -> the trials that it made
ScenesByValue = dict[str, list[str]]  # value of a setting or condition -> the scenes that have it

MAX_NAMED = 6  # the most ingredients that a sentence names; it counts the rest
NO_RECORD = "settings that are not recorded (a trial has no readable config.yaml)"
ELSEWHERE = "a training elsewhere, which left no record"
BY_PROGRAM = "everything that the program {} does differently"
TARGET, INITIAL_CLOUD = "densify._target_", "initial cloud"

TABLES: dict[str, dict[str, list[str]]] = table_beside(__file__, "ingredients.yaml")
DEPARTURES = TABLES["departures"]  # by the densifier's class
INGREDIENT_NAMES = {f"train.{key}": "learning rates" for key in RATES} | {
    key: name for name, keys in TABLES["settings"].items() for key in keys
}
# Conditions and settings that each scene may have for itself. The settings of a budget are not
# among them, so that a note says where it differs. Iterations are a condition already.
OF_A_SCENE = ("resolution", "data", "budget")
ABSENT = "none"  # the value of a condition that a scene's trials do not have


def differing_conditions(trials: Sequence[TrialResult], code: bool = True) -> dict[str, list[str]]:
    """The conditions in which trials differ, with their values.

    With ``code``, versions of the code are conditions too. Different budgets count only if a
    budget limited one of the trials.
    """
    values_by_condition: dict[str, set[str]] = defaultdict(set)
    for trial in trials:
        for key, value in trial.conditions.items():
            values_by_condition[key].add(value)
    for part, versions in (differing_code(trials) if code else {}).items():
        values_by_condition[str(part)] = {version[:SHOWN] for version in versions}
    if not any(trial.budget_acted for trial in trials):
        values_by_condition.pop("budget", None)
    return {key: sorted(values) for key, values in values_by_condition.items() if len(values) > 1}


def differing_settings(trials: Sequence[Trained]) -> dict[str, list[str]]:
    """The settings in which trials differ, with their values, unless `is_ignored`.

    A missing key counts as unset (null): trials from before a setting existed equal later ones that
    leave it unset.
    """
    if len({trial.config_hash for trial in trials}) == 1:
        return {}
    configs = {trial.key: trial.config for trial in trials}.values()
    keys = {key for config in configs for key in config if not is_ignored(key)}
    values_by_key = {key: {canonical(config.get(key)) for config in configs} for key in keys}
    return {key: sorted(values) for key, values in sorted(values_by_key.items()) if len(values) > 1}


def conditions_between_scenes(trials: Sequence[TrialResult]) -> dict[str, ScenesByValue]:
    """The conditions, without `OF_A_SCENE`, in which the scenes of one arm differ.

    A mean over such scenes would be about nothing. A condition that some scenes lack differs only
    if the others do: old trials and those of other programs have fewer.
    """
    found = _between_scenes(trials, attrgetter("conditions"), ABSENT)
    return {
        key: scenes
        for key, scenes in found.items()
        if key not in OF_A_SCENE and len(scenes.keys() - {ABSENT}) > 1
    }


def settings_between_scenes(trials: Sequence[TrialResult]) -> dict[str, ScenesByValue]:
    """The settings in which the scenes of one arm differ, without those of the scene itself."""
    found = _between_scenes([trial for trial in trials if trial.config], attrgetter("config"))
    return {key: own for key, own in found.items() if is_ingredient(key) and not is_of_scene(key)}


def _between_scenes(
    trials: Sequence[TrialResult],
    facts_of: Callable[[TrialResult], Mapping[str, Any]],
    absent: str | None = None,
) -> dict[str, ScenesByValue]:
    """For each fact that differs between scenes, the scenes that have a value.

    What differs within a scene is left out: that is no difference between scenes.
    """
    by_scene = group_by(trials, "scene")
    first, *others = (facts_of(own[0]) for own in by_scene.values()) if by_scene else ({},)
    # Compared as they are, not as text: this runs for every pair of arms.
    keys = {
        key for other in others for key in first.keys() | other if first.get(key) != other.get(key)
    }
    differing: dict[str, ScenesByValue] = {}
    for key in sorted(keys):
        values = {
            scene: {as_text(facts_of(trial).get(key, absent)) for trial in own}
            for scene, own in by_scene.items()
        }
        if all(len(own) == 1 for own in values.values()):
            differing[key] = group_by(values, lambda scene: min(values[scene]))  # noqa: B023
    return {key: scenes for key, scenes in differing.items() if len(scenes) > 1}


def as_text(value: Any) -> str:
    """A value as text; text stays as it is."""
    return value if isinstance(value, str) else canonical(value)


def between_scenes_notes(*sides: Sequence[TrialResult]) -> list[Note]:
    """Notes on arms that have other settings, conditions or code on other scenes.

    A mean over the scenes hides these: an arm may have been tuned for each scene. ``sides`` are
    trials with their variants; arms of one name on two sides are two arms.
    """
    arms_by_text: dict[str, list[str]] = {}
    for side in sides:
        for arm, own in group_by(side, "arm").items():
            differing = conditions_between_scenes(own) | settings_between_scenes(own)
            texts = []
            for key, by_value in differing.items():
                values = [f"{value} on {some_of(scenes)}" for value, scenes in by_value.items()]
                texts.append(f"{key} ({some_of(values)})")
            texts += [f"the version of {part.short}" for part in differing_code(own)]
            if texts:
                arms_by_text.setdefault(some_of(texts), []).append(str(arm))
    return [
        Note.of("scenes differ", arms=list(dict.fromkeys(arms)), differences=text)
        for text, arms in arms_by_text.items()
    ]


def differing_code(trials: Iterable[TrialResult]) -> dict[Part, Versions]:
    """The parts of the code of which the trials used several versions, with these versions.

    If several packages of gsbench differ, the first stands for all of them, under a name that
    counts the others.
    """
    by_part: dict[Part, Versions] = defaultdict(lambda: defaultdict(list))
    for trial in trials:
        for part, version in trial.code.items():
            by_part[part][version].append(trial)
    differing = {part: dict(versions) for part, versions in by_part.items() if len(versions) > 1}
    packages = {part: differing.pop(part) for part in [*differing] if part.kind == "package"}
    for first, versions in [*packages.items()][:1]:
        more = f" and {counted(len(packages) - 1, 'more package')}" if len(packages) > 1 else ""
        differing[Part("package", f"{first.name}{more}")] = versions
    return differing


def ingredients(one: Mapping[str, Any], other: Mapping[str, Any]) -> tuple[str, ...]:
    """The ingredients in which two configurations with dotted keys differ.

    Those of the densifier classes come first.
    """
    if not one or not other:
        return (NO_RECORD,)
    of_one_class = {*_class_ingredients(one)} ^ {*_class_ingredients(other)}
    names = [
        name
        for config in (other, one)
        for name in _class_ingredients(config)
        if name in of_one_class
    ]
    other_init = any(one.get(key) != other.get(key) for key in ("init._target_", "init.name"))
    for key in differing_keys(one, other):
        is_of_one_class = key.startswith("densify.") and ((key in one) != (key in other))
        if key == TARGET or (one.get(TARGET) != other.get(TARGET) and is_of_one_class):
            continue
        is_cloud = other_init and key.startswith("init.") and key not in INGREDIENT_NAMES
        names.append(
            INITIAL_CLOUD if is_cloud else INGREDIENT_NAMES.get(key, key.removeprefix("densify."))
        )
    return tuple(dict.fromkeys(names))


def differing_keys(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """The settings in which two configurations differ, that are ingredients."""
    keys = [key for key in {**one, **other} if one.get(key) != other.get(key)]
    return [key for key in keys if is_ingredient(key)]


def ingredients_between(trials: Sequence[TrialResult], first: Arm, second: Arm) -> tuple[str, ...]:
    """The ingredients in which two arms of ``trials`` differ, versions of the code included.

    Only if there is exactly one, a difference of results can be put down to it.
    """
    names: list[str] = []
    for one, other in compared_trials(trials, first, second):
        if one.made_elsewhere or other.made_elsewhere:
            return (ELSEWHERE,)
        names += [*ingredients(one.config, other.config), *map(str, differing_code((one, other)))]
    return tuple(dict.fromkeys(names))


def compared_trials(trials: Iterable[TrialResult], first: Arm, second: Arm) -> list[TrialPair]:
    """A pair of trials of two arms on each scene that both have, of one seed if possible.

    Without a common scene it is one pair. Raises KeyError for an arm without trials.
    """
    by_arm = group_by(trials, "arm")
    ones, others = by_arm[first], by_arm[second]
    here, there = (group_by(own, "scene") for own in (ones, others))
    shared = [(own, there[scene]) for scene, own in here.items() if scene in there]
    pairs = []
    for mine, theirs in shared or [(ones, others)]:
        of_seed = {trial.seed: trial for trial in reversed(theirs)}
        same = ((one, of_seed[one.seed]) for one in mine if one.seed in of_seed)
        pairs.append(next(same, (mine[0], theirs[0])))
    return pairs


def ingredients_note(names: Sequence[str], first: Arm, second: Arm) -> Note:
    """``sfm-longaxis differs from sfm-adc by split, gradient and threshold.``"""
    if not names:
        return Note.of("no ingredient", arm=second, baseline=first)
    more = [f"{len(names) - MAX_NAMED} more"] if len(names) > MAX_NAMED else []
    alone = "" if is_mixed(names) else " alone"
    shown = [*names[:MAX_NAMED], *more]
    return Note.of("ingredients", arm=second, baseline=first, ingredients=shown, alone=alone)


def is_mixed(names: Sequence[str]) -> bool:
    """Return whether the named ingredients are more than one, or stand for an unknown number."""
    bundles = (NO_RECORD, ELSEWHERE, BY_PROGRAM.partition("{")[0])
    return len(names) > 1 or any(name.startswith(bundles) for name in names)


def _class_ingredients(config: Mapping[str, Any]) -> Sequence[str]:
    """The ingredients in which the configuration's densifier class departs from ADC."""
    target = config.get(TARGET)
    if target is None:
        return ()
    if target == "gsbench.densify.External":
        return (BY_PROGRAM.format(config.get("densify.name")),)
    return DEPARTURES.get(str(target), (f"rule {target}",))
