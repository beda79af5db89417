"""The report's charts along settings: of a search, of a sweep that varied one setting, and of quality against cost."""

from __future__ import annotations

import logging
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from gsbench.analysis.cells import by_key
from gsbench.analysis.configurations import canonical
from gsbench.analysis.differences import differing_settings
from gsbench.analysis.pairing import BASELINE
from gsbench.analysis.quantities import Quantity, choose_quantities, quantity
from gsbench.analysis.report.charts import Series, line_chart, short_number
from gsbench.analysis.results import TrialResult
from gsbench.analysis.tradeoffs import Curve, curve_gap, family_curve
from gsbench.eval.facts import METRICS, find
from gsbench.parsing import DamagedError
from gsbench.runs.tuning_record import Point, TuningRecord, read_tuning
from gsbench.words import counted, signed

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SearchPart:
    """A line in words, and charts as SVG."""

    line: str
    charts: Sequence[str]


def search_part(home: Path) -> SearchPart | None:
    """The report's part on the search of an experiment; None where there was none, or its file cannot be read."""
    try:
        return _part(read_tuning(home))
    except FileNotFoundError:
        return None
    except DamagedError as error:
        log.warning("left out: %s", error)
        return None


def _part(record: TuningRecord) -> SearchPart:
    facts = find(record.metric)
    name = facts.name if facts else record.metric
    decimals = (facts.decimals if facts else 3) + 1
    sign = record.direction
    points = record.points
    done = [(number, point, point.value) for number, point in enumerate(points, 1) if point.value is not None]
    failed = len(points) - len(done)
    count = f"{len(points)} of {counted(record.wanted, 'point')}, each {counted(len(record.seeds), 'seed')}"
    count += f"; {failed} failed" if failed else ""
    if not done:
        return SearchPart(f"{count}; none has a result yet.", [])
    number, best, highest = max(done, key=lambda found: sign * found[2])
    where = ", ".join(f"{key} = {value}" for key, value in best.settings.items())
    line = f"Best {name}: {highest:.{decimals}f} at {where} (point {number}). {count}. "
    line += "Judged by validation views; no test view was looked at."
    so_far: list[tuple[float, float]] = []
    for place, _, found in done:
        known = so_far[-1][1] if so_far else found
        so_far.append((float(place), max(known, found, key=lambda value: sign * value)))
    each = [(float(place), found) for place, _, found in done]
    history = [Series("each point", each), Series("best so far", so_far)]
    charts = [line_chart("The search", history, "point", name, dots=True)]
    charts += [_by_setting(key, done, name, key in record.log, best) for key in best.settings]
    return SearchPart(line, [chart for chart in charts if chart])


def _by_setting(key: str, done: Sequence[tuple[int, Point, float]], name: str, log_scale: bool, best: Point) -> str:
    """The metric over one searched setting: numbers to scale, words side by side."""
    values = [point.settings[key] for _, point, _ in done]
    title = f"{name} by {key.rpartition('.')[2]}"
    if all(isinstance(value, int | float) for value in values):
        line = [(float(value), found) for value, (_, _, found) in zip(values, done, strict=True)]
        marker = (float(best.settings[key]), "best")
        return line_chart(title, [Series("each point", sorted(line))], key, name, log_scale, marker=marker, dots=True)
    names = sorted({str(value) for value in values})
    places = [(float(names.index(str(value))), found) for value, (_, _, found) in zip(values, done, strict=True)]
    return line_chart(title, [Series("each point", sorted(places))], key, name, x_names=names)


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
        for shown in choose_quantities(group):
            series = [
                Series(scene, _deviations(own, setting, places, shown))
                for scene, own in sorted(by_key(group, lambda trial: trial.scene).items())
            ]
            names = [BASELINE if baseline and values[key] is None else _name(values[key]) for key in places]
            label = f"{shown.heading}, minus the scene's mean"
            charts.append(line_chart(f"{shown.name} by {title}", series, setting, label, x_names=names))
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


COST_LABELS = {"gaussians": "Gaussians", "seconds": "training time (s)"}


def tradeoff_charts(trials: Sequence[TrialResult]) -> list[str]:
    """One chart for each pair of main metric and cost; a densifier's variants are the points of its line."""
    charts = []
    for where, own in _by_split(trials):
        for metric in main_metrics(own):
            for cost, label in COST_LABELS.items():
                curves = _curves(own, metric, cost)
                series = [
                    Series("-".join(family), list(zip(curve.cost.tolist(), curve.quality.tolist(), strict=True)))
                    for family, curve in curves.items()
                ]
                title = f"{metric.name} against {label}{where}"
                charts.append(line_chart(title, series, label, metric.heading, log_x=True))
    return [chart for chart in charts if chart]


def tradeoff_gaps(trials: Sequence[TrialResult], baseline: str = BASELINE) -> list[str]:
    """The area between every densifier's curve and the baseline's, in words, where both have several points."""
    lines = []
    for where, own in _by_split(trials):
        for metric in main_metrics(own):
            for cost, label in COST_LABELS.items():
                curves = _curves(own, metric, cost)
                for (init, densify), curve in curves.items():
                    first = curves.get((init, baseline))
                    gap = curve_gap(first, curve) if first is not None and densify != baseline else None
                    if gap is not None:
                        amount = signed(gap.gap, f".{metric.decimals + 1}f")
                        arms = f"{init}-{densify} at the same {label} as {init}-{baseline}{where}"
                        scale = f"from {short_number(gap.low)} to {short_number(gap.high)}, log scale"
                        lines.append(f"{metric.name} of {arms}: {amount} on average ({scale}).")
    return lines


def _by_split(trials: Sequence[TrialResult]) -> list[tuple[str, list[TrialResult]]]:
    """The trials by what was held out, with words for it where that is not one way for all."""
    groups = by_key(trials, lambda trial: trial.split)
    return [(f", {split}" if len(groups) > 1 else "", own) for split, own in groups.items()]


def main_metrics(trials: Sequence[TrialResult]) -> list[Quantity]:
    """PSNR, and the first perceptual metric that is at hand, beginning with the protocol's LPIPS."""
    for name in ("lpips", *(facts.key for facts in METRICS if facts.perceptual)):
        perceptual = quantity(name, trials)
        if all(perceptual.read(trial) is not None for trial in trials):
            return [quantity("psnr", trials), perceptual]
    return [quantity("psnr", trials)]


def _curves(trials: Sequence[TrialResult], metric: Quantity, cost: str) -> dict[tuple[str, str], Curve]:
    families = sorted({(trial.init, trial.densify) for trial in trials})
    curves = {family: family_curve(trials, family, metric, cost) for family in families}
    return {family: curve for family, curve in curves.items() if len(curve.cost)}
