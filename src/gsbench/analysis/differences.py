"""Differences between trials and between arms: conditions, settings, versions of the code, and *ingredients*.

Ingredients are read from the trials' recorded configurations and code: each setting is one, settings that only make
sense together share a name, and a class of densifiers brings those in which it departs from ADC.
"""

import itertools
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from gsbench.analysis.configurations import canonical, departures
from gsbench.analysis.results import Arm, TrialResult, by_key, seeds_words
from gsbench.runs.code import SHOWN
from gsbench.words import counted, listed

Versions = dict[str, list[TrialResult]]  # version -> the trials that it made

# Settings in which trials of one cell may differ: they name the trial or say where it runs, not what is computed.
IGNORED_SETTINGS = (
    *("seed", "name", "device", "threads", "tracking.", "launch.", "hydra.", "experiment", "scene.path"),
    *("eval.primary", "eval.controls", "densify.switches"),
)
MOST_NAMED = 6  # ingredients that a headline names before it counts
NO_RECORD = "settings that are not recorded (a trial has no readable config.yaml)"
ELSEWHERE = "a training elsewhere, which left no record"
BY_PROGRAM = "everything that the program {} does differently"
TARGET, INIT = "densify._target_", "initial cloud"

# Settings with one name for several keys. All others are called as their key, without the group of the densifier.
NAMES = {
    "densify.gradient_threshold": "threshold",
    "densify.threshold_inclusive": "threshold",
    **{f"densify.{key}": "schedule" for key in ("start", "stop", "interval")},
    **{f"train.{key}": "schedule" for key in ("densify_start", "densify_stop", "densify_interval", "mcmc_stop")},
    **{f"densify.{key}": "opacity reset" for key in ("opacity_reset_interval", "opacity_reset_value")},
    "train.opacity_reset_interval": "opacity reset",
    "train.resolution_schedule": "resolution schedule",
    **{f"densify.{key}": "budget" for key in ("max_gaussians", "cap", "governor_dimension")},
    **{f"densify.{key}": "prunings" for key in ("prune_opacity", "prune_size", "prune_screen_radius")},
    **{f"init.{key}": "cameras" for key in ("poses", "align")},
    **{
        f"train.{key}": "learning rates"
        for key in ("position_initial", "position_final", "sh_dc", "sh_rest", "opacity", "scale", "rotation")
    },
}
# Settings without effect on what is trained.
WITHOUT_EFFECT = (
    *IGNORED_SETTINGS,
    *("eval.", "scene.name", "init.name", "densify.name", "raster.name", "runs", "allow_targets", "init.device"),
    *("train.name", "train.log_every", "train.checkpoint_", "train.volume_histogram"),
    *("init.weights", "init.download", "init.threads", "densify.time_limit_minutes"),
)


UNSET = canonical(None)
CODE = "code of "  # how the keys of ``TrialResult.code`` start that are a user's modules


def differing_conditions(trials: Sequence[TrialResult], code: bool = True) -> dict[str, list[str]]:
    """The conditions in which trials differ, with their values; the ``code`` that made them is one, where it counts.

    Unlike budgets of which none acted are no difference: all of the trials grew as they liked.
    """
    seen: dict[str, set[str]] = defaultdict(set)
    for trial in trials:
        for key, value in trial.conditions.items():
            seen[key].add(value)
    for part, versions in (differing_code(trials) if code else {}).items():
        seen[part] = {short_version(version) for version in versions}
    if not any(trial.budget_acted for trial in trials):
        seen.pop("budget", None)
    return {key: sorted(values) for key, values in seen.items() if len(values) > 1}


def differing_settings(trials: Sequence[TrialResult]) -> dict[str, list[str]]:
    """The settings in which trials with different configuration hashes differ, those that may differ left out.

    A key that a configuration lacks counts as unset: a metric that was added later is null in earlier trials.
    """
    if len({trial.config_hash for trial in trials}) == 1:
        return {}
    known = {trial.key: trial.config_texts for trial in trials}.values()
    keys = {key for texts in known for key in texts if not key.startswith(IGNORED_SETTINGS)}
    values = {key: {texts.get(key, UNSET) for texts in known} for key in keys}
    return {key: sorted(found) for key, found in sorted(values.items()) if len(found) > 1}


def differing_code(trials: Iterable[TrialResult]) -> dict[str, Versions]:
    """The user's modules, stages and rooms of gsbench of which the trials used several versions; of many rooms, one."""
    trials = list(trials)
    found = _several(trials, lambda trial: trial.code)
    rooms = list(_several(trials, lambda trial: trial.rooms).items())
    if rooms:
        part, versions = rooms[0]
        found[part if len(rooms) == 1 else f"{part} and {counted(len(rooms) - 1, 'more room')}"] = versions
    return found


def _several(trials: Iterable[TrialResult], parts: Callable[[TrialResult], Mapping[str, str]]) -> dict[str, Versions]:
    found: dict[str, Versions] = defaultdict(lambda: defaultdict(list))
    for trial in trials:
        for part, version in parts(trial).items():
            found[part][version].append(trial)
    return {part: dict(versions) for part, versions in found.items() if len(versions) > 1}


def describe_code(part: str, versions: Mapping[str, Sequence[TrialResult]]) -> str:
    """``mine.Patient: 3fa9c1d2 (garden seeds 0, 1; 2026-11-21 18:40) | …``, the oldest version first."""
    ordered = sorted(versions.items(), key=lambda item: max(trial.finished for trial in item[1]))
    texts = [f"{short_version(version)} ({_places(own)}; {_when(own)})" for version, own in ordered]
    return f"{part.removeprefix(CODE)}: {' | '.join(texts)}"


def short_version(version: str) -> str:
    """A version as people see it: the start of a hash."""
    return version[:SHOWN]


def _places(trials: Sequence[TrialResult]) -> str:
    """``garden seeds 0, 1; room seed 0``"""
    by_scene = sorted(by_key(trials, lambda trial: trial.scene).items())
    return "; ".join(f"{scene} {seeds_words(own)}" for scene, own in by_scene)


def _when(trials: Sequence[TrialResult]) -> str:
    """Time at which the trials were finished: a minute, or the first and the last."""
    times = sorted(trial.finished for trial in trials)
    minutes = [time.strftime("%Y-%m-%d %H:%M", time.localtime(finished)) for finished in times]
    return minutes[0] if minutes[0] == minutes[-1] else f"{minutes[0]} to {minutes[-1]}"


def find_superseded(
    trials: Sequence[TrialResult], present: Callable[[str, TrialResult], str | None] = lambda module, trial: None
) -> dict[Path, str]:
    """Folders of trials whose code is no longer the present one, each with the reason.

    ``present(module, trial)`` is the hash of a user's module as it is now, None where that cannot be seen; then
    the version that finished a trial last is the present one, as it is among the stages of gsbench.
    """
    reasons: dict[Path, str] = {}
    ordered = sorted(trials, key=lambda trial: trial.finished)
    latest = {part: version for trial in ordered for part, version in (trial.code | trial.rooms).items()}
    for trial in trials:
        for part, version in (trial.code | trial.rooms).items():
            name = part.removeprefix(CODE)
            now = present(name, trial) if part.startswith(CODE) else None
            if version != (now or latest[part]):
                words = "it is now" if now else "later trials have"
                newer = short_version(now or latest[part])
                reasons[trial.path] = f"{name} was {short_version(version)}, {words} {newer}"
    return reasons


def ingredients(one: Mapping[str, Any], other: Mapping[str, Any]) -> tuple[str, ...]:
    """The ingredients in which two configurations with dotted keys differ, those of the rule first."""
    if not one or not other:
        return (NO_RECORD,)
    rule = {*_rule_names(one)} ^ {*_rule_names(other)}
    order = [name for config in (other, one) for name in _rule_names(config) if name in rule]
    cloud = one.get("init._target_") != other.get("init._target_") or one.get("init.name") != other.get("init.name")
    for key in differing_keys(one, other):
        if key == TARGET or (one.get(TARGET) != other.get(TARGET) and _belongs_to_rule(key, one, other)):
            continue
        is_cloud = cloud and key.startswith("init.") and key not in NAMES
        order.append(INIT if is_cloud else NAMES.get(key, key.removeprefix("densify.")))
    return tuple(dict.fromkeys(order))


def differing_keys(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """The settings in which two configurations differ, those left out that have no effect on what is trained."""
    keys = [key for key in {**one, **other} if not key.startswith(WITHOUT_EFFECT)]
    return [key for key in keys if one.get(key) != other.get(key)]


def ingredients_between(trials: Sequence[TrialResult], first: Arm, second: Arm) -> tuple[str, ...]:
    """The ingredients in which two arms of ``trials`` differ: of their configurations, and code of several versions.

    A difference can be put down to an ingredient only where it is the one in which the arms differ.
    """
    one, other = representatives(trials, first, second)
    if one.made_elsewhere or other.made_elsewhere:
        return (ELSEWHERE,)
    return tuple(dict.fromkeys([*ingredients(one.config, other.config), *differing_code((one, other))]))


def ingredients_sentence(found: Sequence[str], first: Arm, second: Arm) -> str:
    """``sfm-longaxis differs from sfm-adc by split, gradient and threshold.``"""
    if not found:
        return f"{second} and {first} differ in no recorded setting."
    named = [*found[:MOST_NAMED], *([f"{len(found) - MOST_NAMED} more"] if len(found) > MOST_NAMED else [])]
    return f"{second} differs from {first} by {listed(named)}{'' if is_mixed(found) else ' alone'}."


def is_mixed(found: Sequence[str]) -> bool:
    """Return whether a difference between arms may come from more than one ingredient."""
    return len(found) > 1 or any(_is_bundle(name) for name in found)


def representatives(trials: Iterable[TrialResult], first: Arm, second: Arm) -> tuple[TrialResult, TrialResult]:
    """A trial of each arm, of one scene and seed where there is such a pair, else of one scene, else of one seed.

    Raises ValueError for an arm without trials.
    """
    by_arm = by_key(trials, lambda trial: trial.arm)
    if missing := [arm for arm in (first, second) if arm not in by_arm]:
        raise ValueError(f"no trial of {missing[0]}")
    pairs = itertools.product(by_arm[first], by_arm[second])
    return max(pairs, key=lambda pair: (pair[0].scene == pair[1].scene, pair[0].seed == pair[1].seed))


def _is_bundle(ingredient: str) -> bool:
    """Return whether it stands for many at once, which nobody can tell apart."""
    return ingredient in (NO_RECORD, ELSEWHERE) or ingredient.startswith(BY_PROGRAM.partition("{")[0])


def _belongs_to_rule(key: str, one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Return whether a setting of the densifier is there for one of two classes alone."""
    return key.startswith("densify.") and ((key in one) != (key in other))


def _rule_names(config: Mapping[str, Any]) -> tuple[str, ...]:
    target = config.get(TARGET)
    if target is None:
        return ()
    if target == "gsbench.densify.External":
        return (BY_PROGRAM.format(config.get("densify.name")),)
    return departures().get(str(target), (f"rule {target}",))
