"""Cells of tables (a mean with its deviation), and data frames of trials.

Only repetitions of a trial are averaged: `check_averageable` refuses all others.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

from gsbench.analysis.differences import (
    conditions_between_scenes,
    differing_code,
    differing_conditions,
    differing_settings,
)
from gsbench.analysis.quantities import Quantity, metric_keys
from gsbench.analysis.results import Experiment, TrialResult, group_by
from gsbench.analysis.trial_result import Planned, Trained
from gsbench.errors import InputError
from gsbench.runs.configuration import SHOWN, is_hashed
from gsbench.words import value_words

if TYPE_CHECKING:
    import pandas as pd

C = TypeVar("C", Planned, TrialResult)

IDENTITY = ("experiment", "scene", "init", "densify", "seed")
CONDITIONS = ("protocol", "raster", "iterations")
TRIAL_FIELDS = (*IDENTITY, *CONDITIONS)
MEASUREMENTS = (
    "num_init_points",
    "num_gaussians",
    "scene_extent",
    "peak_memory_mb",
    "train_views",
    "test_views",
)


@dataclass(frozen=True)
class Cell:
    """The mean of a quantity over the trials of a scene, or the mean of several scenes' means.

    ``std`` is the sample deviation (n - 1) over trials, None for a single trial. Over several
    scenes, each seed that all scenes have gives one mean over the scenes, and ``std`` is the
    deviation of these means. ``count`` of ``expected`` trials have a value; over several scenes it
    is the smallest count. ``reason`` says why the value is missing.
    """

    mean: float | None
    std: float | None
    count: int
    expected: int
    scenes: int
    trials: tuple[TrialResult, ...]
    reason: str = ""


def field_value(trial: TrialResult, name: str) -> str:
    """A field of a trial, or a dotted key of its configuration, as text; null if missing."""
    if name in TRIAL_FIELDS:
        return str(getattr(trial.record, name))
    return value_words(str(_settings_with(trial, name).get(name)))


def _settings_with(trial: TrialResult, name: str) -> Mapping[str, Any]:
    """The settings in which to look up ``name``.

    Settings that change no result are only in the trial's own file.
    """
    return trial.config if name in trial.config or is_hashed(name) else trial.whole_config


def check_fields(trials: Sequence[TrialResult], names: Iterable[str]) -> None:
    """Raise ``InputError`` for the first name that is no field or setting of any trial."""
    for name in names:
        if name in TRIAL_FIELDS:
            continue
        if not any(name in _settings_with(trial, name) for trial in trials):
            raise InputError(
                f"no trial has a setting {name!r}; use {', '.join(TRIAL_FIELDS)} or a key of a "
                "trial's config.yaml"
            )


def select_trials(trials: Iterable[TrialResult], where: Mapping[str, str]) -> list[TrialResult]:
    """The trials whose fields have one of the values, which are given with commas between.

    Raises ``InputError`` if there are none.
    """
    kept = list(trials)
    check_fields(kept, where)
    for key, values in where.items():
        # a value may have commas itself, as a list has
        wanted = {values, *values.split(",")}
        kept = [trial for trial in kept if field_value(trial, key) in wanted]
    if not kept:
        asked = ", ".join(f"{key}={value}" for key, value in where.items())
        raise InputError(f"no trial has {asked}")
    return kept


def where_words(where: Mapping[str, str]) -> str:
    """``--where seed=0,1``"""
    return " ".join(f"--where {key}={values}" for key, values in where.items())


def check_averageable(trials: Sequence[TrialResult], where: str) -> None:
    """Raise ``InputError`` with the differing keys unless each scene's trials are repetitions."""
    if code := differing_code(trials):
        versions = {part.short: [one[:SHOWN] for one in made] for part, made in code.items()}
        listed = "; ".join(f"{part}: {' | '.join(own)}" for part, own in versions.items())
        raise InputError(
            f"the table cell {where} would average trials made by different versions of {listed}: "
            "train them again with one of them"
        )
    by_scene = group_by(trials, "scene")
    for scene, group in by_scene.items():
        if keys := differing_conditions(group) or differing_settings(group):
            place = where if "scene=" in where else f"{where}, scene {scene}"
            raise _refusal(place, keys, group)
        for seed, own in sorted(group_by(group, "seed").items()):
            if len(own) > 1:
                paths = ", ".join(trial.label for trial in own)
                raise InputError(
                    f"the table cell {where} has seed {seed} twice: {paths}; remove one of the "
                    "folders"
                )
    if across := conditions_between_scenes(trials):
        raise _refusal(where, {key: list(values) for key, values in across.items()}, trials)


def swept_settings(trials: Iterable[Trained]) -> list[str]:
    """The settings in which trials of one scene and arm differ, unless `is_ignored`."""
    groups = group_by(trials, "scene", "init", "densify").values()
    return sorted(set().union(*map(differing_settings, groups)))


def with_variants(trials: Sequence[C]) -> list[C]:
    """The trials, each with its values of the swept settings as `TrialResult.variant`.

    Trials with different values thus belong to different arms. Only settings that were swept for
    the trial's own initialiser and densifier count, so a further arm renames no other.
    """
    by_densifier = group_by(trials, "init", "densify")
    swept = {key: swept_settings(own) for key, own in by_densifier.items()}
    if not any(swept.values()):
        return list(trials)

    def variant(trial: C) -> tuple[tuple[str, str], ...]:
        own = swept[trial.init, trial.densify]
        return tuple((key, str(trial.config.get(key))) for key in own)

    return [replace(trial, variant=variant(trial)) for trial in trials]


def make_cell(
    trials: Sequence[TrialResult], quantity: Quantity, scenes: Sequence[str], expected: int
) -> Cell:
    """The cell of averageable trials; each of ``scenes`` should have ``expected`` of them."""
    values: dict[str, dict[int, float]] = {scene: {} for scene in scenes}
    for trial in trials:
        value = quantity.read(trial)
        if value is not None:
            values[trial.scene][trial.seed] = value
    count = min((len(group) for group in values.values()), default=0)
    if count == 0:
        given = (trial.unavailable.get(quantity.key) for trial in trials)
        reason = next(filter(None, given), "no value" if trials else "no trial")
        return Cell(None, None, 0, expected, len(values), tuple(trials), short_reason(reason))
    groups = values.values()
    mean = statistics.fmean(statistics.fmean(group.values()) for group in groups)
    shared_seeds = sorted(set.intersection(*map(set, groups)))
    per_seed = [statistics.fmean(group[seed] for group in groups) for seed in shared_seeds]
    std = statistics.stdev(per_seed) if len(per_seed) > 1 else None
    return Cell(mean, std, count, expected, len(values), tuple(trials))


def short_reason(reason: str) -> str:
    """The reason why a metric is missing, in one line.

    For missing weights, ``results.json`` has the full text.
    """
    if reason.startswith("weights not found: "):
        failed = " (the download failed)" if "; the download failed" in reason else ""
        return f"{reason.partition(' (')[0]}{failed}; gsbench doctor says where they come from"
    return reason


def _refusal(
    where: str, keys: Mapping[str, Sequence[str]], trials: Sequence[TrialResult]
) -> InputError:
    listed = "; ".join(f"{key}: {' | '.join(values)}" for key, values in keys.items())
    first = next(iter(keys))
    return InputError(
        f"the table cell {where} would average trials that differ in {listed} (such as "
        f"{trials[0].label} and {trials[-1].label}): choose one with --where {first}=…, or show "
        f"it with --rows …,{first}"
    )


def to_frame(trials: Experiment | Sequence[TrialResult]) -> pd.DataFrame:
    """An experiment's complete trials, or the given ones, as a data frame of a row each.

    It has these columns:

    - ``experiment``, ``scene``, ``init``, ``densify``, ``seed``: the trial's identity;
    - ``arm`` (``sfm-mine[growth=2]``) and ``idea`` (``sfm-mine``), as verdicts name them;
    - every setting in which trials of one scene, initialiser and densifier differ, by its dotted
      key, such as ``densify.max_gaussians``;
    - ``protocol``, ``raster``, ``iterations``, and ``width`` and ``height`` of the views in px;
    - every metric of any trial, as the mean over its test views (``psnr`` in dB; NaN where it could
      not be computed);
    - ``num_init_points``, ``num_gaussians``, ``scene_extent`` (world units), ``peak_memory_mb``,
      ``train_views`` and ``test_views``;
    - ``seconds_init``, ``seconds_train``, ``seconds_evaluate``;
    - ``event_<cause>``: number of Gaussians that the refinements cloned, split, pruned and so on,
      by cause;
    - ``hash_config``, ``hash_data``, ``hash_init`` and so on: hashes of the trial's inputs;
    - ``folder``: the folder of the trial's files.

    A value that a trial does not have is missing (NA), never 0.
    """
    import pandas as pd  # here, since it is slow to import

    chosen = list(trials.trials if isinstance(trials, Experiment) else trials)
    swept, metrics = swept_settings(chosen), metric_keys(chosen)
    rows = []
    for trial in with_variants(chosen):
        record = trial.record
        row: dict[str, Any] = {name: getattr(record, name) for name in IDENTITY}
        row |= {"arm": str(trial.arm), "idea": trial.arm.name}
        row |= {key: trial.config.get(key) for key in swept}
        row |= {name: getattr(record, name) for name in CONDITIONS}
        row["width"], row["height"] = record.resolution or (None, None)
        row |= {key: trial.metrics.get(key) for key in metrics}
        row |= {name: getattr(record, name) for name in MEASUREMENTS}
        row |= {f"seconds_{stage}": value for stage, value in record.seconds.items()}
        row |= {f"event_{cause}": count for cause, count in record.events.items()}
        row |= {f"hash_{name}": sha for name, sha in record.hashes.items()}
        rows.append(row | {"folder": str(trial.path)})
    return pd.DataFrame(rows).convert_dtypes(convert_string=False, convert_floating=False)
