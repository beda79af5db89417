"""Charts as inline SVG, without script or network, each with a description in words.

This module computes positions; the templates ``line_chart`` and ``forest_plot`` write the
elements.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from statistics import median
from types import MappingProxyType

from gsbench.analysis.statistics import Interval
from gsbench.analysis.table_formats import fill
from gsbench.analysis.verdicts import SceneRow
from gsbench.words import true_minus

WIDTH, HEIGHT = 380, 250  # px at full size; text is 12 px
LEFT, RIGHT, TOP, BOTTOM = 58, 18, 26, 44  # margins
FOREST_LEFT, FOREST_TOP, FOREST_ROW = 132, 12, 26
STRETCH = 3.0  # times the median reach of its rows, beyond which intervals of a forest are cut
# distinct for colour-blind readers
COLORS = ("#4477aa", "#cc3311", "#228833", "#aa3377", "#b8860b", "#0099a8")
DASHES = ("", "6 3", "2 3", "8 3 2 3", "1 2", "10 4")
TICKS = 5
THOUSANDS = 1e4  # numbers from here on are written with k or M

Points = Sequence[tuple[float, float]]


def line_chart(
    title: str,
    series: Sequence[tuple[str, Points]],
    x_label: str,
    y_label: str,
    log_x: bool = False,
    bars: Mapping[float, Interval] = MappingProxyType({}),
    level: tuple[float, str] | None = None,
) -> str:
    """Named lines over common axes, of which that of x may be logarithmic; "" without points.

    ``level`` is the y of a named horizontal line, ``bars`` are intervals of y by x.
    """
    shown = [(name, points) for name, points in series if points]
    if not shown:
        return ""
    all_points = [point for _, points in shown for point in points]
    x = Axis([x for x, _ in all_points], log_x, LEFT, WIDTH - RIGHT)
    heights = [y for _, y in all_points] + ([] if level is None else [level[0]])
    heights += [end for bar in bars.values() for end in (bar.low, bar.high)]
    y = Axis(heights, False, HEIGHT - BOTTOM, TOP)
    lines = [
        {
            "name": name,
            "points": [(x.to_px(a), y.to_px(b)) for a, b in points],
            "color": color,
            "dash": dash,
        }
        for (name, points), color, dash in zip(
            shown, itertools.cycle(COLORS), itertools.cycle(DASHES), strict=False
        )
    ]
    words = (
        f"{title}. {y_label} against {x_label}: "
        f"{'; '.join(f'{name} {_ends(points)}' for name, points in shown)}."
    )
    return fill(
        "line_chart.html.j2",
        title=title,
        words=words,
        lines=lines,
        x=x,
        y=y,
        x_label=x_label,
        y_label=y_label,
        bars=[(x.to_px(at), y.to_px(bar.low), y.to_px(bar.high)) for at, bar in bars.items()],
        level=None if level is None else (y.to_px(level[0]), level[1]),
        width=WIDTH,
        height=HEIGHT,
        few=TICKS,
    )


def forest_plot(title: str, rows: Sequence[SceneRow], x_label: str, better: int) -> str:
    """Differences with intervals, one per row, and a line at 0; ``better`` is a gain's sign.

    An interval much wider than the others is cut, so that it does not stretch the axis.
    """
    if not rows:
        return ""
    intervals = [interval for *_, interval in rows if interval]
    reach = [
        max(map(abs, (mean, interval.low, interval.high)))
        for _, mean, _, interval in rows
        if interval
    ]
    most = max([STRETCH * median(reach or [0.0]), *(abs(mean) for _, mean, *_ in rows)])

    def cut(end: float) -> float:
        return min(max(end, -most), most)

    ends = [0.0, *(mean for _, mean, *_ in rows)]
    ends += [cut(end) for interval in intervals for end in (interval.low, interval.high)]
    words = []
    for scene, mean, _, interval in rows:
        words.append(f"{scene} {short_number(mean)}")
        if interval:
            low, high = map(short_number, (interval.low, interval.high))
            words[-1] += f", interval {low} to {high}"
    bottom = FOREST_TOP + FOREST_ROW * len(rows)
    return fill(
        "forest_plot.html.j2",
        title=title,
        words=f"{title}. {x_label}. {'; '.join(words)}.",
        rows=[
            (
                FOREST_TOP + FOREST_ROW * (k + 0.5),
                scene,
                mean,
                forest_color(mean, interval, better),
                (cut(interval.low), cut(interval.high)) if interval else None,
            )
            for k, (scene, mean, _, interval) in enumerate(rows)
        ],
        x=Axis(ends, False, FOREST_LEFT, WIDTH - RIGHT, ticks=3),
        x_label=x_label,
        width=WIDTH,
        height=bottom + BOTTOM,
        top=FOREST_TOP,
        bottom=bottom,
    )


def forest_color(mean: float, interval: Interval | None, better: int) -> str:
    """Grey if the interval contains 0 or is unknown, green on the side ``better``, else red."""
    if interval is None or not interval.excludes_zero():
        return "#555555"
    return "#1b7837" if mean * better > 0.0 else "#b2182b"


ROUND = (1, 2, 2.5, 5, 10)  # steps between ticks, as multiples of a power of ten


class Axis:
    """Maps values to pixels from ``start`` to ``end``, with ticks at round values."""

    def __init__(
        self, values: Sequence[float], log: bool, start: float, end: float, ticks: int = TICKS
    ) -> None:
        self._log, self.start, self.end = log, start, end
        scaled = [self._scale(value) for value in values]
        low, high = min(scaled), max(scaled)
        if high - low < 1e-12:
            pad = abs(high) * 0.05 or 1.0
            low, high = low - pad, high + pad
        margin = 0.04 * (high - low)
        zero_based = not log and min(values) == 0.0
        self._low, self._high = (low if zero_based else low - margin), high + margin
        self.ticks = self._log_ticks() if log else _round_ticks(self._low, self._high, ticks)

    def label(self, tick: float) -> str:
        """The tick's value, with enough digits to differ from its neighbours."""
        step = min((b - a for a, b in itertools.pairwise(self.ticks)), default=0.0)
        if self._log or step == 0 or abs(tick) >= THOUSANDS:
            return short_number(tick)
        decimals = max(0, math.ceil(-math.log10(step) - 1e-9) + (f"{step:e}"[2] != "0"))
        return true_minus(f"{tick:.{decimals}f}")

    def to_px(self, value: float) -> float:
        fraction = (self._scale(value) - self._low) / (self._high - self._low)
        return self.start + fraction * (self.end - self.start)

    def _scale(self, value: float) -> float:
        return math.log10(value) if self._log else value

    def _log_ticks(self) -> list[float]:
        decades = range(math.ceil(self._low), math.floor(self._high) + 1)
        if len(decades) < 2:
            return [10.0**value for value in (self._low, (self._low + self._high) / 2, self._high)]
        return [10.0**exponent for exponent in decades[:: max(1, math.ceil(len(decades) / TICKS))]]


def _round_ticks(low: float, high: float, count: int) -> list[float]:
    """About ``count`` round values from ``low`` to ``high``; two at least, to give a scale."""
    raw = (high - low) / count
    power = 10.0 ** math.floor(math.log10(raw))
    first = next(index for index, factor in enumerate(ROUND) if factor * power >= raw)
    steps = (factor * power for factor in (*reversed(ROUND[: first + 1]), 0.5))
    for step in steps:
        ticks = [k * step for k in range(math.ceil(low / step), math.floor(high / step) + 1)]
        if len(ticks) > 1:
            break
    return ticks


def _ends(points: Points) -> str:
    """The first and the last point of a line in words."""
    (x0, y0), (x1, y1) = points[0], points[-1]
    return (
        f"from {short_number(y0)} at {short_number(x0)} to {short_number(y1)} at {short_number(x1)}"
    )


def short_number(value: float) -> str:
    """A number with up to three digits for a tick label, such as 26k or −0.02."""
    magnitude = abs(value)
    for limit, unit, suffix in ((1e6, 1e6, "M"), (THOUSANDS, 1e3, "k")):
        if magnitude >= limit:
            return true_minus(f"{value / unit:.3g}{suffix}")
    text = (
        f"{value:.0e}"
        if 0 < magnitude < 1e-4
        else f"{value:.3g}"
        if magnitude < 1000
        else f"{value:.0f}"
    )
    return true_minus(text)
