"""The report's part on interpolation and extrapolation: orders that turn, gaps, and the error over the angle."""

from __future__ import annotations

import statistics
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from gsbench.analysis.cells import by_key
from gsbench.analysis.pairing import ViewCache
from gsbench.analysis.quantities import Quantity
from gsbench.analysis.questions import TURNS, UNSURE, Gap, Turn, find_gaps, find_turns, without_split
from gsbench.analysis.report.charts import Series, line_chart
from gsbench.analysis.report.setting_charts import main_metrics
from gsbench.analysis.results import TrialResult
from gsbench.analysis.statistics import Interval
from gsbench.analysis.verdicts import ArmVerdicts, Pair
from gsbench.errors import InputError
from gsbench.scene.nearness import ANGLE, DISTANCE
from gsbench.words import counted, signed

MOST_POINTS = 12  # of a line; more views are taken together in as many bins


@dataclass(frozen=True)
class QuestionPart:
    """Part of the report on questions; ``line`` is the answer, empty where one question alone was asked."""

    line: str
    turned: tuple[str, ...]
    turns: tuple[Turn, ...]
    gaps: tuple[Gap, ...]
    charts: tuple[str, ...]
    places: tuple[str, ...]


def question_part(
    trials: Sequence[TrialResult], judged: Mapping[Pair, ArmVerdicts], views: ViewCache
) -> QuestionPart | None:
    """Both questions side by side, and the metrics over the angle to the nearest training view; None without any."""
    turns, gaps, charts = find_turns(trials, judged), find_gaps(trials), angle_charts(trials, views)
    if not gaps and not charts:
        return None
    turned = tuple(_in_words(turn) for turn in turns if turn.word in (TURNS, UNSURE))
    return QuestionPart(_line(turns), turned, tuple(turns), tuple(gaps), tuple(charts), tuple(places(trials, views)))


def angle_charts(trials: Sequence[TrialResult], views: ViewCache) -> list[str]:
    """Draw, by scene and main metric, the test views' values over their angle to the nearest training view, by arm."""
    arms, charts = without_split(trials), []
    for scene, group in sorted(by_key(trials, lambda trial: trial.scene).items()):
        for metric in main_metrics(group):
            series = []
            for arm, own in sorted(by_key(group, lambda trial: arms[str(trial.path)]).items()):
                series.append(Series(str(arm), binned(_points(own, metric, views))))
            title = f"{metric.name} by distance from training, {scene}"
            label = "angle to the nearest training view (degrees)"
            charts.append(line_chart(title, series, label, metric.heading, dots=True))
    return [chart for chart in charts if chart]


def binned(points: Sequence[tuple[float, float]], most: int = MOST_POINTS) -> list[tuple[float, float]]:
    """Means of (x, y) in at most ``most`` bins of x, in order, filled alike; what rounds to one stays together."""
    alike: dict[int, list[tuple[float, float]]] = defaultdict(list)
    for x, y in points:
        alike[round(x)].append((x, y))
    groups = [alike[key] for key in sorted(alike)]
    bins = min(most, len(groups))
    found = []
    for index in range(bins):
        part = [p for group in groups[index * len(groups) // bins : (index + 1) * len(groups) // bins] for p in group]
        found.append((statistics.fmean(x for x, _ in part), statistics.fmean(y for _, y in part)))
    return found


def places(trials: Sequence[TrialResult], views: ViewCache) -> list[str]:
    """Say for each scene and split what was held out, and how far that is from training."""
    lines = []
    for (scene, split), group in sorted(by_key(trials, lambda trial: (trial.scene, trial.split)).items()):
        rows = _rows(group[0], views)
        angles = sorted(row[ANGLE] for row in rows if ANGLE in row)
        distances = sorted(row[DISTANCE] for row in rows if DISTANCE in row)
        if not angles:
            continue
        question = f", {group[0].question}" if group[0].question else ""
        words = f": {group[0].record.held_out}" if group[0].record.held_out else ""
        far = f", {_span(distances, '.2f')} scene extents" if distances else ""
        lines.append(
            f"{scene}, {split or 'split not recorded'}{question}: {counted(len(rows), 'test view')}, "
            f"{_span(angles, '.1f')} degrees{far} from the nearest training view{words}"
        )
    return lines


def _points(trials: Sequence[TrialResult], metric: Quantity, views: ViewCache) -> list[tuple[float, float]]:
    """(angle, mean over seeds) of every test view of every split."""
    values: dict[tuple[str, str], list[float]] = defaultdict(list)
    angles: dict[tuple[str, str], float] = {}
    for trial in trials:
        try:
            rows = views(trial)
        except InputError:
            continue  # said elsewhere
        for name, row in rows.items():
            if ANGLE in row and metric.key in row:
                values[trial.split, name].append(row[metric.key])
                angles[trial.split, name] = round(row[ANGLE], 3)
    return [(angles[key], statistics.fmean(found)) for key, found in values.items()]


def _rows(trial: TrialResult, views: ViewCache) -> list[Mapping[str, float]]:
    try:
        return list(views(trial).values())
    except InputError:
        return []


def _line(turns: Sequence[Turn]) -> str:
    if not turns:
        return ""
    counts = {word: sum(turn.word == word for turn in turns) for word in (TURNS, UNSURE)}
    metrics = counted(len(turns), "comparison")
    if counts[TURNS]:
        return f"Of {metrics} of two arms in a metric, the order turns in {counts[TURNS]} between the questions."
    unsure = f"; in {counts[UNSURE]} the signs differ, and no verdict says so" if counts[UNSURE] else ""
    return f"Of {metrics} of two arms in a metric, no order turns between the questions{unsure}."


def _in_words(turn: Turn) -> str:
    """``PSNR (dB), sfm-volumetric against sfm-adc: +0.31 (+0.10 to +0.52) at interpolation, −0.20 (…) at …``"""
    digits = f".{turn.quantity.decimals + 1}f"
    sides = [
        f"{signed(one.verdict.mean or 0.0, digits)} ({_interval(one.verdict.interval, digits)}) at {name}"
        for one, name in ((turn.interpolation, "interpolation"), (turn.extrapolation, f"extrapolation, {turn.split}"))
    ]
    pair = f"{turn.second} against {turn.first}"
    said = "the order turns" if turn.word == TURNS else turn.word
    return f"{turn.quantity.name}, {pair}: {', '.join(sides)}: {said}"


def _interval(interval: Interval | None, digits: str) -> str:
    """``+0.10 to +0.52``, or that there is none."""
    return "no interval" if interval is None else f"{signed(interval.low, digits)} to {signed(interval.high, digits)}"


def _span(values: Sequence[float], spec: str) -> str:
    low, high = f"{values[0]:{spec}}", f"{values[-1]:{spec}}"
    return low if low == high else f"{low} to {high}"
