"""The report's charts of a sweep: each metric over the values of the one setting that was varied."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence

from gsbench.analysis.cells import by_key
from gsbench.analysis.configurations import canonical
from gsbench.analysis.differences import differing_settings
from gsbench.analysis.pairing import BASELINE
from gsbench.analysis.quantities import Quantity, choose_quantities
from gsbench.analysis.report.charts import Series, line_chart, short_number
from gsbench.analysis.results import TrialResult

NAMES = ("densify.name", "init.name")  # an arm may be named after the value that it has
FAMILY = ("init.name", "densify._target_")


def sweep_charts(trials: Sequence[TrialResult]) -> list[str]:
    """Draw a chart of each quantity for each initialiser and class of densifier of which one setting was varied.

    A line is a scene, relative to its own mean over the values, so that scenes of unlike levels share an axis and each
    scene's best value can be seen: a threshold in scene units need not suit all scenes. The baseline, which has no such
    setting, stands beside the values.
    """
    charts = []
    several = len({trial.split for trial in trials}) > 1  # what is held out is another question, not another value

    def family_of(trial: TrialResult) -> tuple[object, ...]:
        return (*(trial.config.get(key) for key in FAMILY), trial.split if several else None)

    for family, swept in by_key(trials, family_of).items():
        setting = _varied(swept)
        if setting is None:
            continue
        baseline = _baseline(trials, swept, setting)
        group = [*swept, *baseline]
        values = {canonical(trial.config.get(setting)): trial.config.get(setting) for trial in group}
        places = {key: place for place, key in enumerate(sorted(values, key=lambda key: _order(values[key])))}
        arm = ", ".join(str(part).rpartition(".")[2] for part in family if part is not None)
        title = f"{setting.rpartition('.')[2]} ({arm})"
        for quantity in choose_quantities(group):
            series = [
                Series(scene, _deviations(own, setting, places, quantity))
                for scene, own in sorted(by_key(group, lambda trial: trial.scene).items())
            ]
            names = [BASELINE if baseline and values[key] is None else _name(values[key]) for key in places]
            label = f"{quantity.heading}, minus the scene's mean"
            charts.append(line_chart(f"{quantity.name} by {title}", series, setting, label, x_names=names))
    return [chart for chart in charts if chart]


def _baseline(trials: Sequence[TrialResult], swept: Sequence[TrialResult], setting: str) -> list[TrialResult]:
    """The trials of the baseline beside those ``swept``, where it is one arm and has no such setting."""
    if any(trial.config.get(setting) is None for trial in swept):
        return []
    wanted = (swept[0].init, BASELINE, swept[0].split)
    found = [trial for trial in trials if (trial.init, trial.densify, trial.split) == wanted]
    scenes = by_key(found, lambda trial: trial.scene).values()
    one_arm = not any(differing_settings(own) for own in scenes)
    return found if one_arm and not any(setting in trial.config for trial in found) else []


def _varied(group: Sequence[TrialResult]) -> str | None:
    """The one setting in which the trials of every scene differ, or None where it is none or several."""
    found: set[str] = set()
    for own in by_key(group, lambda trial: trial.scene).values():
        found |= {key for key in differing_settings(own) if key not in NAMES}
    return found.pop() if len(found) == 1 else None


def _deviations(
    trials: Sequence[TrialResult], setting: str, places: Mapping[str, int], quantity: Quantity
) -> list[tuple[float, float]]:
    """(place of the value, mean over seeds minus the mean over all values) of one scene."""
    means: dict[int, float] = {}
    for key, own in by_key(trials, lambda trial: canonical(trial.config.get(setting))).items():
        known = [found for found in map(quantity.read, own) if found is not None]
        if known:
            means[places[key]] = statistics.fmean(known)
    if len(means) < 2:
        return []
    level = statistics.fmean(means.values())
    return [(float(place), mean - level) for place, mean in sorted(means.items())]


def _order(value: object) -> tuple[int, float, str]:
    """Numbers by size, then words, then what is not set."""
    if isinstance(value, int | float):
        return 0, float(value), ""
    return (2, 0.0, "") if value is None else (1, 0.0, str(value))


def _name(value: object) -> str:
    return short_number(value) if isinstance(value, int | float) and not isinstance(value, bool) else str(value)
