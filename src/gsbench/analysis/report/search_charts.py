"""The report's part on a search: how its best came about, and the metric over each setting that was searched."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from gsbench.analysis.report.charts import Series, line_chart
from gsbench.eval.facts import find
from gsbench.parsing import DamagedError
from gsbench.runs.search_record import Point, SearchRecord, read_search
from gsbench.words import counted

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SearchPart:
    """A line in words, and charts as SVG."""

    line: str
    charts: Sequence[str]


def search_part(home: Path) -> SearchPart | None:
    """The report's part on the search of an experiment; None where there was none, or its file cannot be read."""
    try:
        return _part(read_search(home))
    except FileNotFoundError:
        return None
    except DamagedError as error:
        log.warning("left out: %s", error)
        return None


def _part(record: SearchRecord) -> SearchPart:
    facts = find(record.metric)
    name = facts.name if facts else record.metric
    decimals = (facts.decimals if facts else 3) + 1
    sign = record.direction
    points = record.points
    done = [(point, point.value) for point in points if point.value is not None]
    failed = sum(point.state == "failed" for point in points)
    count = f"{len(points)} of {counted(record.wanted, 'point')}, each {counted(record.seeds, 'seed')}"
    count += f"; {failed} failed" if failed else ""
    if not done:
        return SearchPart(f"{count}; none has a result yet.", [])
    best, highest = max(done, key=lambda pair: sign * pair[1])
    where = ", ".join(f"{key} = {value}" for key, value in best.settings.items())
    line = f"Best {name}: {highest:.{decimals}f} at {where} (point {best.number + 1}). {count}. {_judged(record)}"
    so_far: list[tuple[float, float]] = []
    for point, found in done:
        known = so_far[-1][1] if so_far else found
        so_far.append((point.number + 1.0, max(known, found, key=lambda value: sign * value)))
    each = [(point.number + 1.0, found) for point, found in done]
    history = [Series("each point", each), Series("best so far", so_far)]
    charts = [line_chart("The search", history, "point", name, dots=True)]
    charts += [_by_setting(key, done, name, key in record.log, best) for key in best.settings]
    return SearchPart(line, [chart for chart in charts if chart])


def _judged(record: SearchRecord) -> str:
    if record.validation:
        return "Judged by validation views; no test view was looked at."
    return "Judged by the test views, which are therefore no test of it (scene.validation=true judges by others)."


def _by_setting(key: str, done: Sequence[tuple[Point, float]], name: str, log_scale: bool, best: Point) -> str:
    """The metric over one searched setting: numbers to scale, words side by side."""
    values = [point.settings[key] for point, _ in done]
    title = f"{name} by {key.rpartition('.')[2]}"
    if all(isinstance(value, int | float) for value in values):
        line = [(float(value), found) for value, (_, found) in zip(values, done, strict=True)]
        marker = (float(best.settings[key]), "best")
        return line_chart(title, [Series("each point", sorted(line))], key, name, log_scale, marker=marker, dots=True)
    names = sorted({str(value) for value in values})
    places = [(float(names.index(str(value))), found) for value, (_, found) in zip(values, done, strict=True)]
    return line_chart(title, [Series("each point", sorted(places))], key, name, x_names=names)
