"""Attribution of a difference: the ingredients in which two arms differ, and the arm that would isolate one of them.

A difference between arms can be put down to an ingredient only where it is the one in which they differ. Ingredients
are read from the trials' recorded configurations and code: each setting is one, settings that only make sense together
share a name, and a class of densifiers brings those in which it departs from ADC.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from gsbench.analysis.configurations import departures, resolved, shipped_arms
from gsbench.analysis.differences import IGNORED_SETTINGS, differing_code
from gsbench.analysis.results import Arm, TrialResult, by_key
from gsbench.words import listed

MOST_NAMED = 6  # ingredients that a headline names before it counts
NO_RECORD = "what is not recorded (a trial has no readable config.yaml)"
ELSEWHERE = "what a training elsewhere did, of which nothing is recorded"
BY_PROGRAM = "all that the program {} does otherwise"
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


@dataclass(frozen=True)
class Attribution:
    """The ingredients in which a second arm differs from a first, and by which arms single ones are isolated.

    ``isolating`` has for an ingredient the words of an arm that lacks nothing else of the second arm.
    """

    ingredients: tuple[str, ...]
    isolating: Mapping[str, str]

    @property
    def is_mixed(self) -> bool:
        """Return whether a difference between the arms may come from more than one ingredient."""
        return len(self.ingredients) > 1 or any(map(_is_bundle, self.ingredients))


def ingredients(one: Mapping[str, Any], other: Mapping[str, Any]) -> tuple[str, ...]:
    """The ingredients in which two configurations with dotted keys differ, those of the rule first."""
    if not one or not other:
        return (NO_RECORD,)
    rule = _rule(one) ^ _rule(other)
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


def attribute(trials: Sequence[TrialResult], first: Arm, second: Arm) -> Attribution:
    """List where ``second`` differs from ``first``, and which other arm, of these trials or shipped, isolates what.

    An arm isolates an ingredient where it differs from ``second`` by that alone.
    """
    one, other = representatives(trials, first, second)
    found = _ingredients_of(one, other)
    if len(found) < 2:
        return Attribution(found, {})
    isolating: dict[str, str] = {}
    for arm, group in by_key(trials, lambda trial: trial.arm).items():
        if arm not in (first, second):
            pair = representatives([*group, *(trial for trial in trials if trial.arm == second)], arm, second)
            _note(isolating, found, _ingredients_of(*pair), f"{arm}, which is here")
    for name, settings in shipped_arms().items():
        alike = _under_the_same_settings(resolved(settings, other.config), one.config, other.config)
        _note(isolating, found, ingredients(alike, other.config), f"densify={name}")
    return Attribution(found, isolating)


def attribution_sentence(found: Attribution, first: Arm, second: Arm) -> str:
    """``sfm-longaxis differs from sfm-adc by split, gradient and threshold; isolate split with densify=absgrad.``

    Empty where the arms differ in one ingredient, or in none.
    """
    if not found.is_mixed:
        return ""
    named = list(found.ingredients[:MOST_NAMED])
    if more := len(found.ingredients) - len(named):
        named.append(f"{more} more")
    text = f"{second} differs from {first} by {listed(named)}"
    if len(found.ingredients) == 1:
        return f"{text}."
    ways = [f"isolate {name} with {arm}" for name, arm in found.isolating.items()]
    return f"{text}; {'; '.join(ways) or 'no arm at hand isolates one of them'}."


def representatives(trials: Iterable[TrialResult], first: Arm, second: Arm) -> tuple[TrialResult, TrialResult]:
    """A trial of each arm, of one scene and seed where there is such a pair, else of one scene, else of one seed.

    Raises ValueError for an arm without trials.
    """
    by_arm = by_key(trials, lambda trial: trial.arm)
    if missing := [arm for arm in (first, second) if arm not in by_arm]:
        raise ValueError(f"no trial of {missing[0]}")
    likenesses: tuple[Callable[[TrialResult], object], ...] = (
        lambda trial: (trial.scene, trial.seed),
        lambda trial: trial.scene,
        lambda trial: trial.seed,
        lambda trial: None,
    )
    for likeness in likenesses:
        others = by_key(by_arm[second], likeness)
        one = next((trial for trial in by_arm[first] if likeness(trial) in others), None)
        if one is not None:
            break
    assert one is not None
    return one, others[likeness(one)][0]


def _is_bundle(ingredient: str) -> bool:
    """Return whether it stands for many at once, which nobody can tell apart."""
    return ingredient in (NO_RECORD, ELSEWHERE) or ingredient.startswith(BY_PROGRAM.partition("{")[0])


def _ingredients_of(one: TrialResult, other: TrialResult) -> tuple[str, ...]:
    """Those of the configurations, and code of which the trials used two versions."""
    if one.made_elsewhere or other.made_elsewhere:
        return (ELSEWHERE,)
    return tuple(dict.fromkeys([*ingredients(one.config, other.config), *differing_code((one, other))]))


def _note(isolating: dict[str, str], of: Sequence[str], found: Sequence[str], words: str) -> None:
    if len(found) == 1 and found[0] in of:
        isolating.setdefault(found[0], words)


def _under_the_same_settings(
    arm: Mapping[str, Any], one: Mapping[str, Any], other: Mapping[str, Any]
) -> dict[str, Any]:
    """The configuration ``other`` with the densifier ``arm``, and with what was changed alike in both trials' arms."""
    kept = {key: value for key, value in other.items() if not key.startswith("densify.")}
    arms = [resolved(settings, other) for settings in shipped_arms().values()]
    same_class = [shipped for shipped in arms if shipped[TARGET] == other.get(TARGET)]  # adc, absgrad, revised
    as_shipped = min(same_class, key=lambda shipped: len(differing_keys(shipped, _of_arm(other))), default={})
    changed = {
        key: one[key]
        for key in arm
        if key in one and key in as_shipped and one[key] == other.get(key) != as_shipped[key] and key != "densify.name"
    }
    return kept | dict(arm) | changed


def _of_arm(config: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of a configuration's densifier alone."""
    return {key: value for key, value in config.items() if key.startswith("densify.")}


def _belongs_to_rule(key: str, one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Return whether a setting of the densifier is there for one of two classes alone."""
    return key.startswith("densify.") and ((key in one) != (key in other))


def _rule(config: Mapping[str, Any]) -> set[str]:
    return set(_rule_names(config))


def _rule_names(config: Mapping[str, Any]) -> tuple[str, ...]:
    target = config.get(TARGET)
    if target is None:
        return ()
    if target == "gsbench.densify.External":
        return (BY_PROGRAM.format(config.get("densify.name")),)
    return departures().get(str(target), (f"rule {target}",))
